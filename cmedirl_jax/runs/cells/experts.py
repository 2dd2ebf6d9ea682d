"""Demonstrations as in the paper: by DDPG experts trained on the true reward (section 4.1)."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np

from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells import recording, scale
from cmedirl_jax.runs.cells.cell import CellResult, Progress
from cmedirl_jax.runs.cells.compiled import CompiledMethod
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.config import Expert, Experts
from cmedirl_jax.runs.console.phases import phase
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage.checkpoints import Checkpointer

EVALUATION_STARTS = 100
"""Start states on which the experts are ranked."""


def make_pool(
    key: jax.Array,
    env: Env | HostEnv,
    options: Experts,
    programs: CompiledMethod,
    evaluation_starts: int,
    report: Callable[[Progress], None],
    checkpointer: Checkpointer | None = None,
    cluster: Cluster = ALONE,
) -> Demonstrations:
    """Train experts and record noise-free trajectories, from fresh random starts.

    Args:
        key: randomness of training and starts.
        env: the environment.
        options: how many experts, how long, how many trajectories, and who demonstrates.
        programs: DDPG's, with the settings that experts train with.
        evaluation_starts: start states of the learners' evaluations, which those who demonstrate
            are evaluated on too.
        report: called after each chunk of training.
        checkpointer: saves the training as it goes.
        cluster: the processes of the run.

    Raises:
        Interrupted: by the checkpointer.
        UserError: if no expert's final policy reaches the environment's threshold, or is better
            than random actions where it has none.
    """
    # Train.
    train_key, start_key = jax.random.split(key)
    threshold = env.spec.reward_threshold
    result = cell_lib.train(
        programs,
        train_key,
        None,
        0,
        seeds_count=options.seeds,
        budget=Budget(options.steps, None, options.steps, EVALUATION_STARTS),
        threshold=np.inf if threshold is None else threshold,
        report=report,
        checkpointer=checkpointer,
    )
    # Choose who demonstrates, by the final policies' returns.
    returns = _final_returns(result)
    if threshold is None:
        best = float(returns.max())
        threshold = cluster.from_writer(lambda: _better_than_random(env, best))
    chosen = _chosen(returns, options, threshold)

    # Evaluate them as learners are, and record them.
    actors = jax.tree.map(lambda leaf: leaf[chosen], result.final)
    evaluator = programs.evaluator
    with phase("evaluation"):
        scores = evaluator.summarise(evaluator.on_starts(actors, evaluation_starts)).return_mean
    metadata = {
        "env": env.spec.id,
        "source": "noise-free trajectories of DDPG experts trained on the true reward",
        "expert": options.which,
        "experts_trained": options.seeds,
        "experts_solved": int((returns >= threshold).sum()),
        "experts_demonstrating": chosen.tolist(),
        "expert_env_steps": int(result.env_steps.sum()),
        "expert_returns": np.asarray(scores, float).tolist(),
    }
    # On one process for all: rounding on another machine might give other episodes.
    pool = cluster.pool_from_writer(
        lambda: _record(start_key, env, options, programs, actors, metadata)
    )
    assert pool is not None
    return pool


def _chosen(returns: np.ndarray, options: Experts, threshold: float) -> np.ndarray:
    """Who demonstrates; a `UserError` if nobody can."""
    chosen = choose(returns, options.which, threshold)
    if not chosen.size:
        raise UserError(
            f"--experts: none of {options.seeds} experts reached a return of {threshold:g} in "
            f"{options.steps} steps; give them more steps (--experts.steps) or seeds, "
            "and the run another folder"
        )
    return chosen


def _record(
    key: jax.Array,
    env: Env | HostEnv,
    options: Experts,
    programs: CompiledMethod,
    actors: Any,
    metadata: dict[str, Any],
) -> Demonstrations:
    """Record the trajectories of those who demonstrate, actors `[experts, ...]`."""
    experts = metadata["experts_demonstrating"]
    shared = 1 if options.which == "each" else len(experts)
    per_expert = -(-options.trajectories // shared)
    # An expert's episodes do not depend on who else demonstrates.
    keys = [jax.random.fold_in(key, expert) for expert in experts]
    with phase("demonstrations"):
        return recording.record_all(programs.evaluator.act, env, actors, keys, per_expert, metadata)


def _better_than_random(env: Env | HostEnv, best: float) -> float:
    """The return that counts as solved; inf if the best expert is no better than random actions."""
    random = scale.random_return(env, EVALUATION_STARTS)
    return scale.solved(random, best) if best > random else np.inf


def _final_returns(result: CellResult) -> np.ndarray:
    """The return of each expert's final policy, `[experts]`; -inf for one that diverged."""
    final = result.evaluations[-1]
    returns = np.where(result.diverged, -np.inf, 0.0)
    alive = ~result.diverged[final.seed]
    returns[final.seed[alive]] = np.asarray(final.evaluation.return_mean)[alive]
    return returns


def choose(returns: np.ndarray, which: Expert, threshold: float) -> np.ndarray:
    """Which experts demonstrate, `[experts chosen]`; none if none solved the task.

    Args:
        returns: `[experts]`, of each one's final policy.
        which: of those that solved the task the "best", the (lower) "median", or all of them.
        threshold: the return that counts as solved.
    """
    solved = np.flatnonzero(returns >= threshold)
    ranked = solved[np.argsort(returns[solved], kind="stable")]
    match which:
        case "best":
            return ranked[-1:]
        case "median":
            return ranked[(ranked.size - 1) // 2 :][:1]
        case "all" | "each":
            return solved
