"""Noise-free evaluation of a policy on fixed start states."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import VectorEnv

from cmedirl_jax import checks, modes
from cmedirl_jax.envs import Env, playing


class Rollouts(NamedTuple):
    """`B` finished episodes; those of `rollout_on_host` are `[n, E]`.

    Attributes:
        episode_return: `[B]`, undiscounted, of the environment's own reward.
        length: `[B]` int32.
        terminated: `[B]` bool, whether the task itself ended it: a goal, or a fall.
    """

    episode_return: Any
    length: Any
    terminated: Any


class Evaluation(NamedTuple):
    """Statistics over the start states, all `[]`.

    Attributes:
        return_mean: mean undiscounted return.
        return_std: standard deviation of the return over the starts.
        goal_fraction: share of the episodes that the task itself ended, at a goal or otherwise.
        length_mean: mean episode length.
    """

    return_mean: jax.Array
    return_std: jax.Array
    goal_fraction: jax.Array
    length_mean: jax.Array


def rollout(
    policy: Callable[[jax.Array], jax.Array],
    env: Env,
    params: Any,
    starts: tuple[Any, jax.Array],
    key: jax.Array | None = None,
) -> Rollouts:
    """Run `B` episodes side by side to their ends; stops as soon as the last one has ended.

    An episode that the task has not ended after `env.spec.max_episode_steps` steps is cut there.

    Args:
        policy: observations `[B, O]` -> actions `[B, A]`.
        env: the environment.
        params: its parameters.
        starts: states and observations with a leading axis `B`, as `env.starts` gives them.
        key: for environments that draw in `step`; default one fixed key, the same at every call.

    Raises:
        ValueError: if the policy's actions are not `[B, A]`.
        TypeError: if they are not floats.
    """
    states, observations = starts
    count = observations.shape[0]
    key = jax.random.key(0) if key is None else key

    def running(carry) -> jax.Array:
        _, _, done, _, time = carry
        return ~jnp.all(done) & (time < env.spec.max_episode_steps)

    def act(observations: jax.Array) -> jax.Array:
        actions = policy(observations)
        checks.shape("the policy's actions", actions, (count, env.spec.action_dim))
        checks.kind("the policy's actions", actions, jnp.floating)
        return actions

    def advance(carry):
        states, observations, done, result, time = carry
        keys = jax.random.split(jax.random.fold_in(key, time), count)
        states, step = jax.vmap(env.step, in_axes=(0, 0, 0, None))(
            keys, states, act(observations), params
        )
        result = Rollouts(
            episode_return=result.episode_return + jnp.where(done, 0.0, step.reward),
            length=result.length + ~done,
            terminated=result.terminated | (step.terminated & ~done),
        )
        return states, step.observation, done | step.terminated | step.truncated, result, time + 1

    nothing = jnp.zeros(count, bool)
    result = Rollouts(jnp.zeros(count, jnp.float32), jnp.zeros(count, jnp.int32), nothing)
    carry = (states, observations, nothing, result, jnp.zeros((), jnp.int32))
    return jax.lax.while_loop(running, advance, modes.settle(advance, carry))[3]


def rollout_on_host(
    policy: Callable[[np.ndarray], Any], vector: VectorEnv, starts: np.ndarray, limit: int
) -> Rollouts:
    """Play episodes of `n` policies, one a sub-environment; `[n, E]` numpy.

    Args:
        policy: observations `[n, O]` -> actions `[n, A]`.
        vector: `n` sub-environments.
        starts: `[E]`, the reset seeds of each policy's episodes.
        limit: steps after which an episode is cut.
    """
    shape = (vector.num_envs, len(starts))
    result = Rollouts(np.zeros(shape, np.float32), np.zeros(shape, np.int32), np.zeros(shape, bool))
    for played in playing.play(vector, policy, np.broadcast_to(starts, shape), limit):
        at = np.flatnonzero(played.playing), played.episode[played.playing]
        result.episode_return[at] += played.answer.reward[played.playing]
        result.length[at] += 1
        result.terminated[at] = played.answer.terminated[played.playing]
    return result


def summarise(rollouts: Rollouts) -> Evaluation:
    """Reduce the episodes to their statistics."""
    return Evaluation(
        return_mean=jnp.mean(rollouts.episode_return),
        return_std=jnp.std(rollouts.episode_return),
        goal_fraction=jnp.mean(rollouts.terminated.astype(jnp.float32)),
        length_mean=jnp.mean(rollouts.length.astype(jnp.float32)),
    )


def evaluate(
    policy: Callable[[jax.Array], jax.Array], env: Env, params: Any, starts: int
) -> Evaluation:
    """Evaluate `policy` on `starts` fixed start states, the same at every call.

    Raises:
        ValueError: if `starts` is not positive, or the policy's actions are not `[starts, A]`.
        TypeError: if `starts` is not an integer, or the actions are not floats.
    """
    checks.sizes(starts=starts)
    return summarise(rollout(policy, env, params, env.starts(starts, params)))
