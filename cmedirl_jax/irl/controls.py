"""Rewards that learn nothing, to tell what a learned one does from what any extra reward does."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks
from cmedirl_jax.irl import base, regularisers, rewards
from cmedirl_jax.irl.base import RewardLearner, RewardState
from cmedirl_jax.irl.learner import IRLHParams
from cmedirl_jax.optimizers import traced
from cmedirl_jax.types import EnvSpec, Network, Params

PROBES = 1024
"""Pairs at which a random reward is standardised."""


class RandomParams(NamedTuple):
    """A random reward: the network's parameters, and `[]` mean and deviation of its output."""

    network: Params
    mean: jax.Array
    deviation: jax.Array


def constant(value: float) -> RewardLearner:
    """r_D = `value` everywhere."""

    def init(key: jax.Array) -> RewardState:
        del key
        return RewardState(jnp.asarray(value, jnp.float32), (), ())

    def reward(state: RewardState, observation: jax.Array, action: jax.Array) -> jax.Array:
        del action
        return jnp.broadcast_to(state.params, observation.shape[:-1])

    return RewardLearner(init, reward, base.learn_nothing)


def random(
    spec: EnvSpec, hparams: IRLHParams | None = None, *, network: Network | None = None
) -> RewardLearner:
    """r_D = bound tanh(f), f a random network with mean 0 and deviation 1 over uniform pairs.

    So it is of the scale of a learned reward with the same bound, and says nothing.

    Args:
        spec: whose bounds must be finite.
        hparams: of which the bound is read.
        network: default `rewards.mlp(spec)`; its parameters are drawn such that it varies.

    Raises:
        ValueError: if a bound is infinite.
    """
    if not all(np.isfinite(bound).all() for bound in _bounds(spec)):
        raise ValueError(f"{spec.id}: uniform pairs need finite bounds, got {_bounds(spec)}")
    hparams = hparams or IRLHParams()
    network = network or rewards.mlp(spec)

    def init(key: jax.Array) -> RewardState:
        network_key, observation_key, action_key = jax.random.split(key, 3)
        params = network.init(network_key)
        observation_low, observation_high, action_low, action_high = _bounds(spec)
        output = network.apply(
            params,
            _uniform(observation_key, observation_low, observation_high),
            _uniform(action_key, action_low, action_high),
        )
        standardised = RandomParams(params, jnp.mean(output), jnp.std(output))
        return RewardState(standardised, (), traced(hparams))

    def reward(state: RewardState, observation: jax.Array, action: jax.Array) -> jax.Array:
        checks.pairs(spec, observation, action)
        params, mean, deviation = state.params
        output = (network.apply(params, observation, action) - mean) / deviation
        return regularisers.bounded(output, state.hparams.bound)

    return RewardLearner(init, reward, base.learn_nothing)


def _bounds(spec: EnvSpec) -> tuple[np.ndarray, ...]:
    return spec.observation_low, spec.observation_high, spec.action_low, spec.action_high


def _uniform(key: jax.Array, low, high) -> jax.Array:
    return jax.random.uniform(key, (PROBES, len(low)), minval=low, maxval=high)
