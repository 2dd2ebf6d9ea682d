"""Demonstrations as in the paper: by DDPG experts trained on the true reward (section 4.1)."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells.cell import CellResult, Progress
from cmedirl_jax.runs.cells.compiled import CompiledMethod
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.config import Expert, ExpertSettings
from cmedirl_jax.runs.console.phases import phase
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.types import Transition

EVALUATION_STARTS = 100
"""Start states on which the experts are ranked."""


def make_pool(
    key: jax.Array,
    env: Env,
    options: ExpertSettings,
    which: Expert,
    programs: CompiledMethod,
    report: Callable[[Progress], None],
    checkpointer: Checkpointer | None = None,
    cluster: Cluster = ALONE,
) -> Demonstrations:
    """Train experts and record noise-free trajectories, from fresh random starts.

    Args:
        key: randomness of training and starts.
        env: the environment.
        options: how many experts, how long, how many trajectories.
        which: who demonstrates, see `choose`.
        programs: DDPG's, with the settings that experts train with.
        report: called after each chunk of training.
        checkpointer: saves the training as it goes.
        cluster: the processes of the run.

    Raises:
        Interrupted: by the checkpointer.
        UserError: if no expert's final policy reaches the environment's threshold.
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
        threshold=threshold,
        report=report,
        checkpointer=checkpointer,
    )
    # Choose who demonstrates, by the final policies' returns.
    returns = _final_returns(result)
    chosen = choose(returns, which, threshold)
    if not chosen.size:
        raise UserError(
            f"--experts: none of {options.seeds} experts reached a return of {threshold:g} in "
            f"{options.steps} steps; give them more steps (--experts.steps) or seeds, "
            "and the run another folder"
        )
    metadata = {
        "env": env.spec.id,
        "source": "noise-free trajectories of DDPG experts trained on the true reward",
        "expert": which,
        "experts_trained": options.seeds,
        "experts_solved": int((returns >= threshold).sum()),
        "experts_demonstrating": chosen.tolist(),
        "expert_env_steps": int(result.env_steps.sum()),
    }

    # Record, on one process for all: rounding on another machine might give other episodes.
    per_expert = -(-options.trajectories // chosen.size)
    record_all = jax.jit(
        jax.vmap(lambda actor, key: record(programs.evaluator.act, env, actor, key, per_expert))
    )

    def recorded() -> Demonstrations:
        actors = jax.tree.map(lambda leaf: jnp.asarray(leaf[chosen]), result.final)
        with phase("demonstrations"):
            columns = record_all(actors, jax.random.split(start_key, chosen.size))
            transition, running, truncated = jax.tree.map(np.asarray, columns)
            return flatten(transition, running, truncated, metadata)

    pool = cluster.pool_from_writer(recorded)
    assert pool is not None
    return pool


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
        which: of those that solved the task the "best", the (lower) "median", or "all".
        threshold: the return that counts as solved.
    """
    solved = np.flatnonzero(returns >= threshold)
    ranked = solved[np.argsort(returns[solved], kind="stable")]
    match which:
        case "best":
            return ranked[-1:]
        case "median":
            return ranked[(ranked.size - 1) // 2 :][:1]
        case "all":
            return solved


def record(
    act: Callable[[Any, jax.Array], jax.Array],
    env: Env,
    actor: Any,
    key: jax.Array,
    episodes: int,
) -> tuple[Transition, jax.Array, jax.Array]:
    """Record `episodes` noise-free episodes side by side from random starts.

    An episode that the task has not ended after `env.spec.max_episode_steps` steps is cut there.

    Returns:
        Transitions `[episodes, max_episode_steps, ...]`, whether the episode was still running at
        that step, and whether the time limit cut it off there.
    """
    params = env.default_params
    reset_key, step_key = jax.random.split(key)
    states, observations = jax.vmap(env.reset, in_axes=(0, None))(
        jax.random.split(reset_key, episodes), params
    )

    def advance(carry, time):
        states, observations, running = carry
        actions = act(actor, observations)
        keys = jax.random.split(jax.random.fold_in(step_key, time), episodes)
        states, step = jax.vmap(env.step, in_axes=(0, 0, 0, None))(keys, states, actions, params)
        transition = Transition(
            observations, actions, step.reward, step.observation, step.terminated
        )
        at_limit = time + 1 >= env.spec.max_episode_steps
        truncated = (step.truncated | at_limit) & ~step.terminated
        ended = step.terminated | truncated
        return (states, step.observation, running & ~ended), (transition, running, truncated)

    carry = (states, observations, jnp.ones(episodes, bool))
    _, columns = jax.lax.scan(advance, carry, jnp.arange(env.spec.max_episode_steps))
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), columns)


def flatten(
    transition: Transition, running: np.ndarray, truncated: np.ndarray, metadata: dict[str, Any]
) -> Demonstrations:
    """Lay recorded episodes `[..., episodes, time]` end to end and note their return."""
    running = running.reshape(-1, running.shape[-1])

    def keep(leaf: np.ndarray) -> np.ndarray:
        return leaf.reshape(*running.shape, *leaf.shape[transition.reward.ndim :])[running]

    pool = Demonstrations(
        transition=jax.tree.map(keep, transition),
        truncated=keep(truncated),
        episode=np.repeat(np.arange(len(running), dtype=np.int32), running.sum(axis=1)),
        metadata=metadata,
    )
    returns = demonstrations.returns(pool)
    summary = {"return_mean": float(returns.mean()), "return_std": float(returns.std())}
    return pool._replace(metadata={**metadata, **summary})
