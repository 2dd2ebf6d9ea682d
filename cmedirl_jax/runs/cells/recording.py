"""Recording noise-free episodes of policies as a pool of demonstrations."""

import contextlib
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv, playing
from cmedirl_jax.envs.playing import Played
from cmedirl_jax.types import Transition


def record_all(
    act: Callable[[Any, jax.Array], jax.Array],
    env: Env | HostEnv,
    actors: Any,
    keys: Sequence[jax.Array],
    episodes: int,
    metadata: dict[str, Any],
) -> Demonstrations:
    """Record episodes of actors, one actor after the other; see `record_each`.

    Args:
        act: `(actor, observation [..., O]) -> action [..., A]`.
        env: the task.
        actors: the policies' parameters `[P, ...]`.
        keys: of each policy's starts.
        episodes: of each policy.
        metadata: of the pool, which gets the episodes' mean return and its deviation too.
    """
    return joined(record_each(act, env, actors, keys, episodes), metadata)


def record_each(
    act: Callable[[Any, jax.Array], jax.Array],
    env: Env | HostEnv,
    actors: Any,
    keys: Sequence[jax.Array],
    episodes: int,
) -> list[Demonstrations]:
    """The pool of each actor, without metadata; `record_all` describes the arguments."""
    if isinstance(env, HostEnv):
        return record_on_host(act, env, actors, keys, episodes)
    record_one = jax.jit(lambda actor, key: record(act, env, actor, key, episodes))
    parts = []
    for index, key in enumerate(keys):
        actor = jax.tree.map(lambda leaf, index=index: leaf[index], actors)
        parts.append(flatten(*jax.tree.map(np.asarray, record_one(actor, key))))
    return parts


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

    # Until the last episode ends; what comes after stays zero.
    limit = env.spec.max_episode_steps
    start = (states, observations, jnp.ones(episodes, bool))
    shapes = jax.eval_shape(advance, start, jnp.int32(0))[1]
    columns = jax.tree.map(lambda leaf: jnp.zeros((limit, *leaf.shape), leaf.dtype), shapes)

    def more(carry) -> jax.Array:
        (_, _, running), _, time = carry
        return jnp.any(running) & (time < limit)

    def write(carry):
        now, columns, time = carry
        now, row = advance(now, time)
        columns = jax.tree.map(lambda column, new: column.at[time].set(new), columns, row)
        return now, columns, time + 1

    _, columns, _ = jax.lax.while_loop(more, write, (start, columns, jnp.int32(0)))
    return jax.tree.map(lambda leaf: jnp.swapaxes(leaf, 0, 1), columns)


def record_on_host(
    act: Callable[[Any, jax.Array], jax.Array],
    env: HostEnv,
    actors: Any,
    keys: Sequence[jax.Array],
    episodes: int,
) -> list[Demonstrations]:
    """As `record_each`, for a task on the host."""
    act_all = jax.jit(jax.vmap(act))
    seeds = np.stack([jax.random.bits(key, (episodes,), jnp.uint32) for key in keys])
    with contextlib.closing(env.vector(len(keys))) as vector:
        return of_steps(
            playing.play(
                vector, lambda seen: act_all(actors, seen), seeds, env.spec.max_episode_steps
            )
        )


def of_steps(played: Iterable[Played]) -> list[Demonstrations]:
    """What sub-environments played, as a pool of each, without metadata."""
    steps = jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *played)

    def pool(player: int) -> Demonstrations:
        own = jax.tree.map(lambda leaf: leaf[player][steps.playing[player]], steps)
        transition = Transition(
            own.observation,
            own.action,
            own.answer.reward,
            own.answer.observation,
            own.answer.terminated,
        )
        return Demonstrations(transition, own.truncated, own.episode.astype(np.int32), {})

    return [pool(player) for player in range(len(steps.playing))]


def flatten(transition: Transition, running: np.ndarray, truncated: np.ndarray) -> Demonstrations:
    """Lay recorded episodes `[episodes, time]` end to end, without metadata."""
    return Demonstrations(
        transition=jax.tree.map(lambda leaf: leaf[running], transition),
        truncated=truncated[running],
        episode=np.repeat(np.arange(len(running), dtype=np.int32), running.sum(axis=1)),
        metadata={},
    )


def joined(pools: Sequence[Demonstrations], metadata: dict[str, Any]) -> Demonstrations:
    """Lay pools end to end and note the return of all their episodes in the metadata."""
    counts = [int(pool.episode[-1]) + 1 for pool in pools]
    firsts = np.cumsum([0, *counts[:-1]], dtype=np.int32)
    pool = Demonstrations(
        jax.tree.map(lambda *leaves: np.concatenate(leaves), *(pool.transition for pool in pools)),
        np.concatenate([pool.truncated for pool in pools]),
        np.concatenate([pool.episode + first for pool, first in zip(pools, firsts, strict=True)]),
        metadata,
    )
    returns = demonstrations.returns(pool)
    summary = {"return_mean": float(returns.mean()), "return_std": float(returns.std())}
    return pool._replace(metadata={**metadata, **summary})
