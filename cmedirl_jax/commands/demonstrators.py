"""Who demonstrates when `cmedirl demos record` records, and what a dataset says of them."""

import importlib.metadata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import polars as pl

from cmedirl_jax.commands import evaluate, sources
from cmedirl_jax.commands.sources import Policy
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.cells import scale
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells
from cmedirl_jax.types import EnvSpec

Quality = Literal["expert", "medium", "mixed"]
STARTS = 100
"""Fixed starts from which both reference scores are measured."""


class Demonstrators(NamedTuple):
    """Who demonstrates.

    Attributes:
        task: its name.
        policies: `(observation [O]) -> action [A]`, who play in turn.
        metadata: what a pool says of them.
    """

    task: str
    policies: Sequence[Callable[[np.ndarray], Any]]
    metadata: dict[str, Any]


def of_seed(run: Path, one: Policy, seed: int) -> Demonstrators:
    """One learner of a run."""
    metadata = {"source": f"{one.method}, seed {seed}, of {run.name}, without exploration noise"}
    return Demonstrators(one.task, [jax.jit(one.act)], metadata | {"algorithm_name": one.method})


def of_quality(
    run: Path,
    one: Policy,
    n_demos: int | None,
    quality: Quality,
    episodes: int,
    reference: float | None,
) -> Demonstrators:
    """Those of a run's learners that have a quality.

    Learners are chosen by what their best policies returned at the end of the run, from random
    starts. The metadata have Minari's reference scores, from fixed ones: the mean returns of random
    actions and of the expert.

    Args:
        run: the run's folder.
        one: the policy of any of the learners.
        n_demos: demonstrations of the learners, where the run has several numbers of them.
        quality: expert, medium or mixed.
        episodes: how many will be recorded; no more learners play.
        reference: the expert's return; default what the run's best policy returns.

    Raises:
        UserError: if no policy's return is known, or the expert is no better than random actions.
    """
    env = sources.task(one.task)
    returns = _returns(run, one.method, n_demos)
    worst = scale.random_return(env, STARTS)
    (expert,) = chosen_of(returns, worst, np.inf, "expert")
    if reference is None:
        act = sources.policy(run, one.method, expert, n_demos).act
        reference = float(np.mean(evaluate.rollouts(env, act, STARTS).episode_return))
    if not reference > worst:
        raise UserError(
            f"--quality: the expert returns {reference:.4g} and random actions {worst:.4g}: there "
            "is no expert"
        )
    chosen = chosen_of(returns, worst, reference, quality)[:episodes]
    who = f"{len(chosen)} learners in turn" if quality == "mixed" else f"seed {chosen[0]}"
    metadata = {
        "source": f"{one.method}, {quality}: {who} of the {len(returns)} of {run.name}, without "
        "exploration noise",
        "algorithm_name": one.method,
        "learners": chosen,
        "ref_min_score": worst,
        "ref_max_score": reference,
    }
    policies = [sources.policy(run, one.method, each, n_demos).act for each in chosen]
    return Demonstrators(one.task, [jax.jit(act) for act in policies], metadata)


def _returns(run: Path, method: str, n_demos: int | None) -> np.ndarray:
    """`[seeds]`, the mean return of each learner's best policy on random starts; NaN if unknown."""
    rows = [
        cell.table("seeds").select("seed", "best_return")
        for cell in cells.finished(run)
        if cell.key.method == method and n_demos in (None, cell.key.n_demos)
    ]
    return pl.concat(rows).sort("seed")["best_return"].cast(pl.Float64).to_numpy()


def chosen_of(returns: np.ndarray, worst: float, best: float, quality: Quality) -> list[int]:
    """The learners of a quality.

    Args:
        returns: `[seeds]`, of the learners; those that are not finite are never chosen.
        worst: the mean return of random actions.
        best: that of the expert.
        quality: expert, medium or mixed.

    Raises:
        UserError: if no return is finite.
    """
    known = np.flatnonzero(np.isfinite(returns))
    if not known.size:
        raise UserError("--quality: no learner's return is known")
    if quality == "mixed":
        return known.tolist()
    aim = returns[known].max() if quality == "expert" else (worst + best) / 2
    return [int(known[np.argmin(np.abs(returns[known] - aim))])]


def datasheet(pool: Demonstrations, spec: EnvSpec) -> str:
    """What a dataset says of itself, as Markdown: composition and collection."""
    returns, known = demonstrations.returns(pool), pool.metadata
    length = demonstrations.episodes(pool).length
    ended = int(np.sum(pool.transition.terminated))
    lines = [
        f"Episodes of {spec.id}.",
        "",
        "## Composition",
        "",
        f"- {len(length)} episodes, {int(length.sum())} steps; {int(length.min())} to "
        f"{int(length.max())} steps an episode; the task ended {ended}, the time limit the others",
        f"- returns {sources.spread(returns)}, from {returns.min():.4g} to {returns.max():.4g}",
    ]
    if "ref_max_score" in known:
        worst, best = known["ref_min_score"], known["ref_max_score"]
        lines += [
            f"- random actions return {worst:.4g}, the expert {best:.4g}, both from {STARTS} fixed "
            f"starts: this dataset scores {(returns.mean() - worst) / (best - worst):.2f}",
        ]
    lines += [
        f"- {spec.observation_dim} observations, {spec.action_dim} actions, float32; every episode "
        "that was played is in it",
        "",
        "## Collection",
        "",
        f"- who acted: {known['source']}",
        f"- starts: the task's own, drawn by reset seeds {known['seeds'][0]} to "
        f"{known['seeds'][-1]}",
        f"- recorded by cmedirl_jax {importlib.metadata.version('cmedirl-jax')}",
    ]
    return "\n".join(lines) + "\n"
