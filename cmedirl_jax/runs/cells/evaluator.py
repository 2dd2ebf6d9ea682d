"""Noise-free rollouts of many seeds' policies, compiled once and shared by every method."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import compilation, networks
from cmedirl_jax.envs import Env
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cluster.base import ALONE
from cmedirl_jax.training import evaluation, seeds
from cmedirl_jax.training.evaluation import Evaluation, Rollouts


class Evaluator(NamedTuple):
    """Compiled functions of policies' parameters `[seeds, ...]`, any number of seeds.

    Attributes:
        on_starts: `(actors, count, groups=None) -> Rollouts` `[seeds, count]`, from the fixed start
            states. With `groups` only so many groups of seeds on each device; the others get zeros.
        on_fresh_starts: `(actors, key, count) -> Rollouts` `[seeds, count]`, from random ones, the
            same for every seed.
        act: `(actor, observation [..., O]) -> action [..., A]` for one seed, not compiled.
        gather: arrays of all devices as numpy, see `cluster.base.Cluster`.
    """

    on_starts: Callable[..., Rollouts]
    on_fresh_starts: Callable[[Any, jax.Array, int], Rollouts]
    act: Callable[[Any, jax.Array], jax.Array]
    gather: Callable[[Any], Any]

    def summarise(self, rollouts: Rollouts) -> Evaluation:
        """Each seed's statistics over its starts, `[seeds]`, on the host."""
        return self.gather(_summarise(rollouts))


_summarise = jax.jit(jax.vmap(evaluation.summarise))


def of_networks(
    env: Env,
    architecture: Architecture,
    group: int,
    devices: Sequence[Any],
    gather: Callable[[Any], Any] = ALONE.gather,
) -> Evaluator:
    """An evaluator of actors of one architecture; see `make`."""
    act = functools.partial(networks.policy, networks.make(env.spec, architecture))
    return make(env, act, group, devices, gather)


def make(
    env: Env,
    act: Callable[[Any, jax.Array], jax.Array],
    group: int,
    devices: Sequence[Any],
    gather: Callable[[Any], Any] = ALONE.gather,
) -> Evaluator:
    """An evaluator of policies.

    Args:
        env: the task.
        act: `(actor, observation [..., O]) -> action [..., A]`.
        group: seeds that are evaluated together on a device.
        devices: that share the seeds.
        gather: arrays of all devices as numpy.
    """
    params = env.default_params

    def on_starts(actors: Any, count: int, groups: int | None = None) -> Rollouts:
        return spread(actors, env.starts(count, params), groups)

    def on_fresh_starts(actors: Any, key: jax.Array, count: int) -> Rollouts:
        reset = jax.vmap(env.reset, in_axes=(0, None))
        return spread(actors, reset(jax.random.split(key, count), params))

    def one(actor: Any, starts: Any) -> tuple[Any, Rollouts]:
        return actor, evaluation.rollout(functools.partial(act, actor), env, params, starts)

    @compilation.jit
    def spread(actors: Any, starts: Any, groups: int | None = None) -> Rollouts:
        # Copies of the first seed fill the last group.
        count = jax.tree.leaves(actors)[0].shape[0]
        slots = seeds.padded(count, group, len(devices))
        filled = jax.tree.map(
            lambda x: jnp.concatenate([x, x[:1].repeat(slots - count, 0)]), actors
        )
        if groups is None:
            groups = slots // (group * len(devices))
        mapped = seeds.map_devices(seeds.step_groups(one, group), devices)
        _, rollouts = mapped(filled, groups, starts)
        return jax.tree.map(lambda x: x[:count], rollouts)

    return Evaluator(on_starts, on_fresh_starts, act, gather)
