"""The rules of `claims`: from the seeds of finished runs to a verdict on each claim.

First all comparisons of the page are made, then Holm's correction, then the outcomes.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import polars as pl

from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.intervals import Interval
from cmedirl_jax.runs.report.summary import cell_label
from cmedirl_jax.training.methods import PAPER_METHODS
from experiments.evidence import Comparison, Evidence, Outcome, Sign
from experiments.measures import DIPS, FINAL, STABLE, STEPS
from experiments.pooled import CellName, Pooled

FACTOR = 1.5
"""About n episodes: within this factor."""
NEAR = 5.0
"""Near the expert: less than this below it."""


class Part(NamedTuple):
    """A part of a claim: what was measured, and whether it is as claimed."""

    measured: str
    outcome: Outcome


class Claim(NamedTuple):
    """A claim of the paper, judged.

    Attributes:
        name: C1 to C10.
        text: in a line.
        parts: what was measured; empty if nothing could be.
        why: nothing was measured.
    """

    name: str
    text: str
    parts: tuple[Part, ...]
    why: str = ""

    @property
    def verdict(self) -> str:
        """supported, supported in part, not supported, inconclusive, or not testable."""
        outcomes = {part.outcome for part in self.parts}
        if not outcomes:
            return "not testable"
        if outcomes == {"yes"}:
            return "supported"
        if outcomes == {"no"}:
            return "not supported"
        return "supported in part" if {"yes", "no"} <= outcomes else "inconclusive"


def judge(runs: Sequence[Pooled]) -> list[Claim]:
    """Judge every claim by the runs that can tell; all have the same settings."""
    evidence = Evidence(runs)
    claims = [rule(evidence) for rule in _RULES]
    # A second time, with the p-values of all the tests that the first time asked for.
    evidence.adjust()
    claims = [rule(evidence) for rule in _RULES]
    nothing = "It is a statement about proofs; the paper gives none, and no run can."
    return [*claims, Claim("C10", "The method is convex, with performance guarantees", (), nothing)]


def _claim(name: str, text: str, parts: Sequence[Part | None], why: str) -> Claim:
    """A claim of whose parts those that no run has are None."""
    if not any(parts):
        return Claim(name, text, (), why)
    missing = Part("another method or number of demonstrations that no run has", "unclear")
    return Claim(name, text, tuple(part or missing for part in parts))


def _differing(comparison: Comparison | None, sign: Sign) -> Part | None:
    return None if comparison is None else Part(str(comparison), comparison.differs(sign))


def _no_better(comparison: Comparison | None, better: Sign, what: str) -> Part | None:
    if comparison is None:
        return None
    return Part(f"{what}: {comparison}", comparison.no_better(better))


def _near_experts(evidence: Evidence) -> Claim:
    parts = [_near_expert(evidence, evidence.largest(method)) for method in PAPER_METHODS]
    text = "After about 120 episodes all methods are near the expert"
    return _claim("C1", text, parts, "No run has the methods.")


def _near_expert(evidence: Evidence, name: CellName) -> Part | None:
    run = evidence.run_with(name, by_episodes=True)
    if run is None:
        return None
    experts = _experts(run)
    if not set(run.cells[name].pair.tolist()) <= experts.keys():
        return Part(f"{cell_label(*name)}: no table says what its seeds' experts return", "unclear")
    behind = _behind_experts(run, name, experts, episodes=120)
    if behind is None:
        return Part(f"{cell_label(*name)}: some seeds live no 120 episodes here", "unclear")
    outcome: Outcome = "unclear"
    if behind.low >= -NEAR:
        outcome = "yes"
    elif behind.high < -NEAR:
        outcome = "no"
    measured = f"return minus the expert's at 120 episodes: {_shown(behind)}"
    return Part(f"{cell_label(*name)}, {measured}", outcome)


def _experts(run: Pooled) -> dict[int, tuple[int, float]]:
    """By pair, its expert, whom every method of a pair shares, and what that returns."""
    return {
        pair: (expert, score)
        for cell in run.cells.values()
        for pair, expert, score in zip(
            *(x.tolist() for x in (cell.pair, cell.expert, cell.expert_return)), strict=True
        )
        if np.isfinite(score)
    }


def _behind_experts(
    run: Pooled, name: CellName, experts: dict[int, tuple[int, float]], episodes: int
) -> Interval | None:
    """Return minus the expert's at each seed's first evaluation from so many episodes on."""
    cell = run.cells[name]
    reached = (
        cell.evaluations.filter(pl.col("episode") >= episodes, pl.col("protocol") != "soft")
        .sort("episode", "env_step")
        .group_by("pair")
        .first()
        .sort("pair")
    )
    if reached.height < cell.pair.size:
        return None
    clusters, scores = map(np.array, zip(*(experts[pair] for pair in reached["pair"]), strict=True))
    difference = reached["return_mean"].cast(pl.Float64).to_numpy() - scores
    return intervals.mean(difference, clusters=clusters if (clusters >= 0).all() else None)


def _shown(interval: Interval, form: str = "{:+.2f}") -> str:
    mean, low, high = (form.format(value) for value in interval)
    return f"{mean} [{low}, {high}]"


def _best_of_all(evidence: Evidence) -> Claim:
    parts: list[Part | None] = []
    for other in PAPER_METHODS[:3]:
        faster, stable, dips = (
            evidence.compare_methods("hs-me-ddpg", other, by) for by in (STEPS, STABLE, DIPS)
        )
        parts.append(_differing(faster, "less"))
        # Where as many seeds stay solved, the share of their evaluations decides.
        alike = stable is not None and stable.equivalent
        parts.append(_differing(dips, "less") if alike else _differing(stable, "more"))
    text = "HS-ME-DDPG is the most stable and the fastest"
    return _claim("C2", text, parts, "No run has HS-ME-DDPG and another method.")


def _fast_then_no_better(evidence: Evidence) -> Claim:
    faster, final = (evidence.compare_methods("hs-ddpg", "ddpg", by) for by in (STEPS, FINAL))
    parts = [_differing(faster, "less"), _no_better(final, "more", "no better")]
    text = "HS-DDPG rises fast, then is no better than DDPG"
    return _claim("C3", text, parts, "No run has both methods.")


def _about(
    evidence: Evidence, claim: str, text: str, methods: Sequence[str], episodes: int
) -> Claim:
    """A claim that methods converge after about so many episodes."""
    parts = [_converges(evidence, evidence.largest(method), episodes) for method in methods]
    return _claim(claim, text, parts, "No run has the methods.")


def _converges(evidence: Evidence, name: CellName, episodes: int) -> Part | None:
    run = evidence.run_with(name, by_episodes=True)
    if run is None:
        return None
    found = run.cells[name].statistics.convergence_episode
    if run.episodes is None and not np.isfinite(found).all():
        return Part(f"{cell_label(*name)}: seeds that failed lived fewer episodes", "unclear")
    median = intervals.median(found)
    low, high = episodes / FACTOR, episodes * FACTOR
    outcome: Outcome = "unclear"
    if median.within(low, high):
        outcome = "yes"
    elif median.high < low or median.low > high:
        outcome = "no"
    measured = f"{cell_label(*name)}, median episodes until convergence: {_shown(median, '{:.0f}')}"
    return Part(f"{measured}; claimed {low:.0f} to {high:.0f}", outcome)


def _improves_with_demonstrations(evidence: Evidence) -> Claim:
    numbers = evidence.numbers("hs-ddpg")
    parts: list[Part | None] = []
    if len(numbers) > 2:
        chosen = (numbers[0], numbers[len(numbers) // 2], numbers[-1])
        least, middle, most = (("hs-ddpg", number) for number in chosen)
        gain, rest = (evidence.compare(most, other, STEPS) for other in (least, middle))
        parts.append(_differing(gain, "less"))
        # What does not improve cannot saturate.
        if gain is not None and gain.differs("less") == "yes":
            parts.append(_no_better(rest, "less", "saturates"))
    text = "HS-DDPG's convergence improves with N_T, and saturates early"
    why = "No run has HS-DDPG with three numbers of demonstrations."
    return _claim("C5", text, parts, why)


def _exceeds_expert(evidence: Evidence) -> Claim:
    parts = [
        _differing(evidence.above_expert(evidence.largest(method), FINAL), "more")
        for method in PAPER_METHODS[2:]
    ]
    text = "ME-DDPG and HS-ME-DDPG exceed the expert"
    return _claim("C7", text, parts, "No run says what its experts return.")


def _better_than(evidence: Evidence, claim: str, text: str, other: str) -> Claim:
    parts = [
        _differing(evidence.compare_methods(method, other, FINAL), "more")
        for method in PAPER_METHODS[2:]
    ]
    return _claim(claim, text, parts, f"No run has {other} beside the methods.")


_RULES: tuple[Callable[[Evidence], Claim], ...] = (
    _near_experts,
    _best_of_all,
    _fast_then_no_better,
    lambda evidence: _about(
        evidence, "C4", "DDPG converges after about 120 episodes", ["ddpg"], 120
    ),
    _improves_with_demonstrations,
    lambda evidence: _about(
        evidence,
        "C6",
        "ME-DDPG and HS-ME-DDPG converge after about 50 episodes",
        ["me-ddpg", "hs-me-ddpg"],
        50,
    ),
    _exceeds_expert,
    lambda evidence: _better_than(
        evidence, "C8", "ME-DDPG and HS-ME-DDPG are better than supervised learning", "bc"
    ),
    lambda evidence: _better_than(
        evidence,
        "C9",
        "ME-DDPG and HS-ME-DDPG are significantly better than the original maximum-entropy IRL",
        "maxent-irl",
    ),
)
