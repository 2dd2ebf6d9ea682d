"""The learned policies in Gymnasium's own environment, beside the same episodes in JAX."""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells.evaluator import Evaluator

STARTS = 3
"""Start states per policy."""


class ReplayedReturns(NamedTuple):
    """Returns of the same episodes in the two environments, `[seeds, STARTS]` each."""

    gymnasium_return: np.ndarray
    jax_return: np.ndarray


def replay(evaluator: Evaluator, actors: Any, env: Env | HostEnv) -> ReplayedReturns | None:
    """Run each seed's policy `[seeds, ...]` from the same starts in both environments.

    None where the task is Gymnasium's own, or does not say what Gymnasium's state is.
    """
    if isinstance(env, HostEnv) or env.gymnasium_state is None:
        return None
    jax_return = evaluator.gather(evaluator.on_starts(actors, STARTS).episode_return)
    act = jax.jit(jax.vmap(evaluator.act))
    gymnasium_return = _run(lambda observations: act(actors, observations), actors, env)
    return ReplayedReturns(gymnasium_return, jax_return)


def _run(act: Callable[[jax.Array], jax.Array], actors: Any, env: Env) -> np.ndarray:
    """Step all seeds' Gymnasium environments side by side; returns `[seeds, STARTS]`.

    Episodes are cut after `env.spec.max_episode_steps` steps, as in JAX.
    """
    assert env.gymnasium_state is not None
    count = jax.tree.leaves(actors)[0].shape[0]
    states, observations = env.starts(STARTS, env.default_params)
    states = env.gymnasium_state(states)
    environments = [[gymnasium.make(env.spec.id) for _ in range(STARTS)] for _ in range(count)]
    current = np.broadcast_to(observations, (count, *observations.shape)).copy()
    for row in environments:
        for environment, state in zip(row, states, strict=True):
            environment.reset(seed=0)
            # Gymnasium has no reset to a given state; for classic control it is the attribute.
            environment.unwrapped.state = state.copy()  # type: ignore[attr-defined]
    returns = np.zeros((count, STARTS))
    running = np.ones((count, STARTS), bool)
    for _ in range(env.spec.max_episode_steps):
        if not running.any():
            break
        actions = np.asarray(act(jnp.asarray(current)))
        for seed, start in zip(*np.nonzero(running), strict=True):
            observation, reward, terminated, truncated, _ = environments[seed][start].step(
                actions[seed, start]
            )
            current[seed, start] = observation
            returns[seed, start] += float(reward)
            running[seed, start] = not (terminated or truncated)
    for row in environments:
        for environment in row:
            environment.close()
    return returns
