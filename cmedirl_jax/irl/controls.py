"""Rewards that learn nothing: controls for the effect of adding any reward at all."""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, normalisation, ranges
from cmedirl_jax.hyperparameters import traced
from cmedirl_jax.irl import base, regularisers, rewards
from cmedirl_jax.irl.base import RewardLearner, RewardState
from cmedirl_jax.irl.learner import IRLHParams
from cmedirl_jax.ranges import Positive
from cmedirl_jax.types import EnvSpec, Network, Params

PROBES = 1024
"""State-action pairs over which a random reward is standardised."""


@dataclasses.dataclass(frozen=True)
class ControlSettings:
    """Controls without information about the task.

    Attributes:
        random_share: Bound of a random reward, as a share of reward.bound. It sets the reward's
            standard deviation: at the default that of a learned reward over the replay of `tuned`
            (column r_d_std of evaluations.parquet).
    """

    random_share: Positive = 0.64


class RandomParams(NamedTuple):
    """Parameters of a random reward.

    Attributes:
        network: parameters of f.
        mean: `[]`, mean of f over uniform pairs.
        deviation: `[]`, standard deviation of f over uniform pairs.
    """

    network: Params
    mean: jax.Array
    deviation: jax.Array


def constant(value: float) -> RewardLearner:
    """Make r_D = `value` everywhere.

    Raises:
        ValueError: if the value is not finite.
    """
    checks.within(ranges.FINITE, value=value)
    return RewardLearner(
        init=lambda key: RewardState(jnp.asarray(value, jnp.float32), (), ()),
        reward=lambda state, observation, action: jnp.broadcast_to(
            state.params, observation.shape[:-1]
        ),
        update=base.learn_nothing,
    )


def random(
    spec: EnvSpec,
    hparams: IRLHParams | None = None,
    *,
    share: float = 1.0,
    network: Network | None = None,
) -> RewardLearner:
    """Make r_D = share bound tanh(f), f a random network.

    f has mean 0 and deviation 1 over uniform pairs; observations without sensible bounds are drawn
    as their statistics will make them, normal. The reward carries no information about the task.
    With the bound of a learned reward it varies more; `share` makes them comparable.

    Args:
        spec: the environment's sizes and bounds.
        hparams: only the bound is read.
        share: of the bound, positive.
        network: default `rewards.mlp(spec)`. Its first parameters have to make it vary.

    Raises:
        ValueError: if the specification contradicts itself, or the bound of the reward or `share`
            is out of range.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    hparams = hparams or IRLHParams()
    ranges.check(hparams)
    checks.positive(share=share)
    network = network or rewards.mlp(spec)
    return RewardLearner(
        init=functools.partial(_init_random, spec, network, hparams),
        reward=functools.partial(_random_reward, spec, network, share),
        update=base.learn_nothing,
    )


def _init_random(
    spec: EnvSpec, network: Network, hparams: IRLHParams, key: jax.Array
) -> RewardState:
    network_key, observation_key, action_key = jax.random.split(key, 3)
    params = network.init(network_key)
    output = network.apply(
        params,
        _observations(observation_key, spec),
        _uniform(action_key, spec.action_low, spec.action_high),
    )
    standardised = RandomParams(params, jnp.mean(output), jnp.std(output))
    return RewardState(standardised, (), traced(hparams))


def _random_reward(
    spec: EnvSpec,
    network: Network,
    share: float,
    state: RewardState,
    observation: jax.Array,
    action: jax.Array,
) -> jax.Array:
    checks.pairs(spec, observation, action)
    params, mean, deviation = state.params
    output = (network.apply(params, observation, action) - mean) / deviation
    return regularisers.bounded(output, share * state.hparams.bound)


def _observations(key: jax.Array, spec: EnvSpec) -> jax.Array:
    known = normalisation.sensible(spec)
    if known.all():
        return _uniform(key, spec.observation_low, spec.observation_high)
    uniform_key, normal_key = jax.random.split(key)
    low, high = (
        np.where(known, bound, end)
        for bound, end in ((spec.observation_low, 0.0), (spec.observation_high, 1.0))
    )
    normal = jax.random.normal(normal_key, (PROBES, len(known)), jnp.float32)
    return jnp.where(known, _uniform(uniform_key, low, high), normal)


def _uniform(key: jax.Array, low: np.ndarray, high: np.ndarray) -> jax.Array:
    return jax.random.uniform(key, (PROBES, len(low)), jnp.float32, minval=low, maxval=high)
