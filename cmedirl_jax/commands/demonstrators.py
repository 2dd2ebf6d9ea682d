"""Who demonstrates when `cmedirl demos record` records, and what a dataset says of them."""

import importlib.metadata
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import numpy as np
import polars as pl

from cmedirl_jax.commands import sources
from cmedirl_jax.commands.sources import Policy
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.cells import scale
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import tables
from cmedirl_jax.types import EnvSpec

Quality = Literal["expert", "medium", "mixed"]
STARTS = 100
"""Starts of the random actions whose mean return is the lower reference score."""


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
    metadata = {"source": f"{one.method}, seed {seed}, of {run.name}"}
    return Demonstrators(one.task, [jax.jit(one.act)], metadata | {"algorithm_name": one.method})


def of_quality(
    run: Path, one: Policy, n_demos: int | None, quality: Quality, best: float | None
) -> Demonstrators:
    """Those of a run's learners that have a quality.

    Their metadata have Minari's reference scores: the mean returns of random actions and of the
    expert.

    Args:
        run: the run's folder.
        one: the policy of any of the learners.
        n_demos: demonstrations of the learners, where the run has several numbers of them.
        quality: expert, medium or mixed.
        best: what the expert returns; default what the run's best policy does.
    """
    returns = _returns(run, one.method, n_demos)
    worst = scale.random_return(sources.task(one.task), STARTS)
    best = float(returns.max()) if best is None else best
    chosen = chosen_of(returns, worst, best, quality)
    who = "every learner" if quality == "mixed" else f"seed {chosen[0]}"
    metadata = {
        "source": f"{one.method}, {quality}: {who} of {len(returns)}, of {run.name}",
        "algorithm_name": one.method,
        "quality": quality,
        "learners": chosen,
        "ref_min_score": worst,
        "ref_max_score": best,
    }
    policies = [sources.policy(run, one.method, each, n_demos).act for each in chosen]
    return Demonstrators(one.task, [jax.jit(act) for act in policies], metadata)


def _returns(run: Path, method: str, n_demos: int | None) -> np.ndarray:
    """`[seeds]`, the mean return of each learner's best policy on fresh starts."""
    rows = tables.read(run, run_folder.read(run)["config"])["seeds"]
    rows = rows.filter(pl.col("method") == method)
    if n_demos is not None:
        rows = rows.filter(pl.col("n_demos") == n_demos)
    return rows.sort("seed")["best_return"].to_numpy()


def chosen_of(returns: np.ndarray, worst: float, best: float, quality: Quality) -> list[int]:
    """The learners of a quality.

    Args:
        returns: `[seeds]`, of the learners.
        worst: the mean return of random actions.
        best: that of the expert.
        quality: expert, medium or mixed.
    """
    if quality == "mixed":
        return list(range(len(returns)))
    aim = returns.max() if quality == "expert" else (worst + best) / 2
    return [int(np.argmin(np.abs(returns - aim)))]


def datasheet(pool: Demonstrations, spec: EnvSpec) -> str:
    """What a dataset says of itself, as Markdown: composition, collection, uses and limits."""
    returns, known = demonstrations.returns(pool), pool.metadata
    length = demonstrations.episodes(pool).length
    ended = int(np.sum(pool.transition.terminated))
    lines = [
        f"Noise-free episodes of {spec.id}.",
        "",
        "## Composition",
        "",
        f"- {len(length)} episodes, {int(length.sum())} steps; {int(length.min())} to "
        f"{int(length.max())} steps an episode; the task ended {ended}, the time limit the others",
        f"- returns {returns.mean():.4g} ± {returns.std():.2g}, from {returns.min():.4g} to "
        f"{returns.max():.4g}",
    ]
    if "ref_max_score" in known:
        worst, best = known["ref_min_score"], known["ref_max_score"]
        lines += [
            f"- random actions return {worst:.4g}, the expert {best:.4g}: this "
            f"dataset scores {(returns.mean() - worst) / (best - worst):.2f}",
        ]
    lines += [
        f"- {spec.observation_dim} observations, {spec.action_dim} actions, float32; nothing is "
        "left out, and no step is repeated",
        "",
        "## Collection",
        "",
        f"- who acted: {known['source']}",
        f"- starts: the task's own, drawn by reset seeds {known['seeds'][0]} to "
        f"{known['seeds'][-1]}",
        f"- recorded by cmedirl_jax {importlib.metadata.version('cmedirl-jax')}",
        "",
        "## Uses and limits",
        "",
        "- imitation and inverse reinforcement learning from simulated experts; no person and no "
        "machine of the real world is in it",
    ]
    if known.get("quality") == "mixed":
        lines.append("- episodes of policies that failed are among them, in turn with the others")
    elif "quality" in known or len(set(known.get("learners", [0]))) == 1:
        lines.append("- one policy acted: its habits are no property of the task")
    return "\n".join(lines) + "\n"
