"""Multi-layer perceptrons for the actor, the critic and the reward, as Linen modules.

The paper states no architecture; the defaults here are the ones the `tuned` preset was chosen with:
two hidden layers of 64 ReLU units, layer normalisation in the critic alone, observations scaled to
[-1, 1]. Initialisation follows DDPG (Lillicrap et al. 2015, section 7): U(+-1/sqrt(fan_in)), and a
small uniform range for the last layer.
"""

import dataclasses
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks
from cmedirl_jax.ranges import Count, NotNegative, Size
from cmedirl_jax.types import EnvSpec, Network, Params

Normalisation = Literal["none", "layer", "batch"]


class ActorCritic(NamedTuple):
    """The two networks of DDPG.

    Attributes:
        actor: `apply(params, observation [..., O]) -> pre-activation [..., A]`, unbounded.
        critic: `apply(params, observation [..., O], action [..., A]) -> value [...]`.
        squash: `(pre-activation [..., A]) -> action [..., A]`, onto the action bounds. The two
            steps are apart because the pre-activation is what the saturation penalty acts on.
        spec: the environment they are made for.
    """

    actor: Network
    critic: Network
    squash: Callable[[jax.Array], jax.Array]
    spec: EnvSpec


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Sizes and switches of the actor and the critic. All static.

    Attributes:
        hidden: Units of each hidden layer, for the actor and the critic alike.
        actor_normalisation: Normalisation of the actor's hidden layers (before the ReLU).
        critic_normalisation: Normalisation of the critic's hidden layers (before the ReLU).
        normalise_observation: Map the observation bounds to [-1, 1] at the input of each network.
        action_layer: Layer of the critic at which the action joins (0: the input; Lillicrap et al.:
            1).
        output_scale: Half-width of the uniform initialisation of the last layer.
    """

    hidden: tuple[Size, ...] = (64, 64)
    actor_normalisation: Normalisation = "none"
    critic_normalisation: Normalisation = "layer"
    normalise_observation: bool = True
    action_layer: Count = 0
    output_scale: NotNegative = 3e-3


class MLP(nn.Module):
    """A perceptron whose second input (the action), if any, joins at layer `join`.

    Attributes:
        hidden: units of each hidden layer.
        output_dim: units of the last, linear layer.
        normalisation: of each hidden layer, before its ReLU.
        join: index of the layer that also sees the second input; `len(hidden)` is the last one.
        output_scale: half-width of the last layer's uniform initialisation.
    """

    hidden: tuple[int, ...]
    output_dim: int
    normalisation: Normalisation = "none"
    join: int = 0
    output_scale: float = 3e-3

    @nn.compact
    def __call__(self, x: jax.Array, joined: jax.Array | None = None, train: bool = False):
        """Return `[..., output_dim]` for `x` of `[..., D]` and `joined` of `[..., E]` or None."""
        for index, units in enumerate(self.hidden):
            if joined is not None and index == self.join:
                x = jnp.concatenate([x, joined], axis=-1)
            x = _dense(units, 1.0 / np.sqrt(x.shape[-1]))(x)
            if self.normalisation == "layer":
                x = nn.LayerNorm(epsilon=1e-5, use_bias=False, use_scale=False)(x)
            elif self.normalisation == "batch":
                x = nn.BatchNorm(use_running_average=not train, momentum=0.99)(x)
            x = nn.relu(x)
        if joined is not None and self.join == len(self.hidden):
            x = jnp.concatenate([x, joined], axis=-1)
        return _dense(self.output_dim, self.output_scale)(x)


def actor(spec: EnvSpec, architecture: Architecture) -> Network:
    """A deterministic policy up to its squashing: observation `[..., O]` -> `[..., A]`."""
    mlp = MLP(
        hidden=architecture.hidden,
        output_dim=spec.action_dim,
        normalisation=architecture.actor_normalisation,
        output_scale=architecture.output_scale,
    )
    scale = observation_scaling(spec) if architecture.normalise_observation else _identity
    return from_module(
        lambda variables, observation, **kwargs: mlp.apply(variables, scale(observation), **kwargs),
        lambda key: mlp.init(key, jnp.zeros((1, spec.observation_dim))),
    )


def critic(spec: EnvSpec, architecture: Architecture) -> Network:
    """An action-value function: observation `[..., O]`, action `[..., A]` -> value `[...]`."""
    if not 0 <= architecture.action_layer <= len(architecture.hidden):
        raise ValueError(
            f"action_layer must be between 0 and {len(architecture.hidden)}, the number of hidden "
            f"layers, got {architecture.action_layer}"
        )
    mlp = MLP(
        hidden=architecture.hidden,
        output_dim=1,
        normalisation=architecture.critic_normalisation,
        join=architecture.action_layer,
        output_scale=architecture.output_scale,
    )
    scale = observation_scaling(spec) if architecture.normalise_observation else _identity
    network = from_module(
        lambda variables, observation, action, **kwargs: mlp.apply(
            variables, scale(observation), action, **kwargs
        ),
        lambda key: mlp.init(
            key, jnp.zeros((1, spec.observation_dim)), jnp.zeros((1, spec.action_dim))
        ),
    )
    return scalar_output(network)


def make(spec: EnvSpec, architecture: Architecture | None = None) -> ActorCritic:
    """The actor, the critic and the squashing onto `spec`'s action bounds."""
    architecture = architecture or Architecture()
    return ActorCritic(actor(spec, architecture), critic(spec, architecture), squashing(spec), spec)


def policy(networks: ActorCritic, actor: Params, observation: jax.Array) -> jax.Array:
    """mu(s), without noise: observation `[..., O]` -> action `[..., A]`."""
    return networks.squash(networks.actor.apply(actor, observation))


def imitation_error(
    networks: ActorCritic,
    actor: Params,
    observation: jax.Array,
    action: jax.Array,
    counts: jax.Array | None = None,
) -> tuple[jax.Array, Params]:
    """Mean squared error of mu(s) to demonstrated actions, in training mode, and the parameters.

    Args:
        networks: whose actor.
        actor: its parameters.
        observation: `[B, O]`.
        action: `[B, A]`.
        counts: `[B]` bool; the others add zeros to a mean that stays over all. None: all count.
    """
    pre_activation, actor = train_mode(networks.actor)(actor, observation)
    squared = jnp.square(networks.squash(pre_activation) - action)
    if counts is not None:
        squared = jnp.where(counts[:, None], squared, 0.0)
    return jnp.mean(squared), actor


def squashing(spec: EnvSpec) -> Callable[[jax.Array], jax.Array]:
    """Tanh onto the action bounds: `[..., A]` -> `[..., A]`."""
    centre = jnp.asarray(0.5 * (spec.action_high + spec.action_low))
    half_width = jnp.asarray(0.5 * (spec.action_high - spec.action_low))
    return lambda pre_activation: centre + half_width * jnp.tanh(pre_activation)


def observation_scaling(spec: EnvSpec) -> Callable[[jax.Array], jax.Array]:
    """The affine map from `spec`'s observation bounds to [-1, 1]: `[..., O]` -> `[..., O]`.

    It raises ValueError for another last axis, and TypeError for what is not floats.

    Raises:
        ValueError: if a bound is infinite.
    """
    if not (np.isfinite(spec.observation_low).all() and np.isfinite(spec.observation_high).all()):
        raise ValueError(
            f"{spec.id}: observations can only be normalised by finite bounds, "
            f"got {spec.observation_low} and {spec.observation_high}"
        )
    centre = 0.5 * (spec.observation_high + spec.observation_low)
    half_width = 0.5 * (spec.observation_high - spec.observation_low)

    def scale(observation: jax.Array) -> jax.Array:
        checks.vectors("observation", observation, spec.observation_dim)
        return (observation - centre) / half_width

    return scale


def from_module(apply: Callable[..., Any], init: Callable[[jax.Array], Params]) -> Network:
    """Wrap a Linen `apply` (taking `train=` and `mutable=`) and `init` as a `Network`.

    The network gets a `train` function where its variables hold a `batch_stats` collection.
    """
    has_statistics = "batch_stats" in jax.eval_shape(init, jax.random.key(0))
    if not has_statistics:
        return Network(init, apply)

    def train(variables: Params, *inputs: jax.Array) -> tuple[jax.Array, Params]:
        output, moved = apply(variables, *inputs, train=True, mutable=["batch_stats"])
        return output, {**variables, **moved}

    return Network(init, apply, train)


def scalar_output(network: Network) -> Network:
    """Drop the last axis, of size one, of a network's output."""

    def apply(params: Params, *inputs: jax.Array) -> jax.Array:
        return network.apply(params, *inputs)[..., 0]

    if network.train is None:
        return Network(network.init, apply)
    network_train = network.train

    def train(params: Params, *inputs: jax.Array) -> tuple[jax.Array, Params]:
        output, params = network_train(params, *inputs)
        return output[..., 0], params

    return Network(network.init, apply, train)


def train_mode(network: Network) -> Callable[..., tuple[jax.Array, Params]]:
    """`network.train`, or for a network without statistics its `apply` and unchanged parameters."""
    if network.train is not None:
        return network.train
    return lambda params, *inputs: (network.apply(params, *inputs), params)


def _dense(units: int, bound: float) -> nn.Dense:
    """A dense layer whose kernel and bias are drawn from U(-bound, bound)."""

    def uniform(key: jax.Array, shape: tuple[int, ...], dtype=jnp.float32) -> jax.Array:
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return nn.Dense(units, kernel_init=uniform, bias_init=uniform)


def _identity(observation: jax.Array) -> jax.Array:
    return observation
