"""Noise-free rollouts of many seeds' policies, compiled once and shared by every method."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import evaluation, networks, seeds
from cmedirl_jax.envs import Env
from cmedirl_jax.evaluation import Evaluation, Rollouts
from cmedirl_jax.networks import Architecture


class Judge(NamedTuple):
    """Compiled functions of actor parameters `[seeds, ...]`, any number of seeds.

    Attributes:
        on_starts: `(actors, count) -> Rollouts` `[seeds, count]`, from the fixed start states.
        on_fresh_starts: `(actors, key, count) -> Rollouts` `[seeds, count]`, from random ones, the
            same for every seed.
        act: `(actor, observation [..., O]) -> action [..., A]` for one seed, not compiled.
    """

    on_starts: Callable[[Any, int], Rollouts]
    on_fresh_starts: Callable[[Any, jax.Array, int], Rollouts]
    act: Callable[[Any, jax.Array], jax.Array]


def make(env: Env, architecture: Architecture, group: int, devices: list[jax.Device]) -> Judge:
    """A judge of policies of one architecture, in groups of `group` seeds on each device."""
    actor_critic = networks.make(env.spec, architecture)
    params = env.default_params

    def act(actor: Any, observation: jax.Array) -> jax.Array:
        return networks.policy(actor_critic, actor, observation)

    def on_starts(actors: Any, count: int) -> Rollouts:
        return spread(actors, env.starts(count, params))

    def on_fresh_starts(actors: Any, key: jax.Array, count: int) -> Rollouts:
        reset = jax.vmap(env.reset, in_axes=(0, None))
        return spread(actors, reset(jax.random.split(key, count), params))

    def one(actor: Any, starts: Any) -> Rollouts:
        return evaluation.rollout(functools.partial(act, actor), env, params, starts)

    def spread(actors: Any, starts: Any) -> Rollouts:
        count = jax.tree.leaves(actors)[0].shape[0]
        extra = seeds.padded(count, group, len(devices)) - count
        filled = jax.tree.map(lambda x: jnp.concatenate([x, x[:1].repeat(extra, 0)]), actors)
        found = seeds.map_devices(seeds.map_groups(one, group), devices)(filled, starts)
        return jax.tree.map(lambda x: x[:count], found)

    return Judge(
        on_starts=jax.jit(on_starts, static_argnums=1),
        on_fresh_starts=jax.jit(on_fresh_starts, static_argnums=2),
        act=act,
    )


def summarise(rollouts: Rollouts) -> Evaluation:
    """Each seed's statistics over its starts, `[seeds]`, on the host."""
    return jax.tree.map(np.asarray, jax.vmap(evaluation.summarise)(rollouts))
