"""Multi-layer perceptrons for the actor, the critic and the reward, as Linen modules.

The paper states no architecture. The defaults are those of the `tuned` preset: two hidden layers
of 64 ReLU units, layer normalisation in the critic only, observations scaled to [-1, 1].
Initialisation follows DDPG (Lillicrap et al. 2015, section 7): U(+-1/sqrt(fan_in)), and a small
uniform range for the last layer.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, modes, normalisation, products, ranges
from cmedirl_jax.normalisation import Normalise
from cmedirl_jax.ranges import Count, NotNegative, Size
from cmedirl_jax.types import EnvSpec, Network, Params

Normalisation = Literal["none", "layer", "batch"]


class ActorCritic(NamedTuple):
    """The two networks of DDPG.

    Attributes:
        actor: `apply(params, observation [..., O]) -> pre-activation [..., A]`, unbounded.
        critic: `apply(params, observation [..., O], action [..., A]) -> value [...]`.
        squash: `(pre-activation [..., A]) -> action [..., A]`, onto the action bounds. It is not
            part of `actor`, because the saturation penalty acts on the pre-activation.
        spec: the environment that they are made for.
    """

    actor: Network
    critic: Network
    squash: Callable[[jax.Array], jax.Array]
    spec: EnvSpec


@dataclasses.dataclass(frozen=True)
class Architecture:
    """Sizes and switches of the actor and the critic. All static.

    Attributes:
        hidden: Units of each hidden layer, of the actor and of the critic.
        actor_normalisation: Normalisation of the actor's hidden layers, before each ReLU.
        critic_normalisation: Normalisation of the critic's hidden layers, before each ReLU.
        normalise_observation: At the input of each network, the reward's too. bounds: map them to
            [-1, 1] where they are sensible, elsewhere take off the mean of the demonstrations'
            observations (without demonstrations, of the learner's own so far) and divide by their
            standard deviation; statistics: do this everywhere; none.
        action_layer: Index of the critic's layer at which the action joins (0: the input;
            Lillicrap et al.: 1).
        output_scale: Half-width of the uniform initialisation of the last layer's parameters.
    """

    hidden: tuple[Size, ...] = (64, 64)
    actor_normalisation: Normalisation = "none"
    critic_normalisation: Normalisation = "layer"
    normalise_observation: Normalise = "bounds"
    action_layer: Count = 0
    output_scale: NotNegative = 3e-3


class MLP(nn.Module):
    """A perceptron whose second input (the action), if any, joins at layer `join`.

    Attributes:
        hidden: units of each hidden layer.
        output_dim: units of the last, linear layer.
        normalisation: of each hidden layer, before its ReLU.
        join: index of the layer at which the second input joins; `len(hidden)` is the last one.
        output_scale: half-width of the last layer's uniform initialisation.
    """

    hidden: tuple[int, ...]
    output_dim: int
    normalisation: Normalisation = "none"
    join: int = 0
    output_scale: float = 3e-3

    @nn.compact
    def __call__(self, x: jax.Array, joined: jax.Array | None = None, train: bool = False):
        """Return `[..., output_dim]`.

        Args:
            x: `[..., D]`.
            joined: the second input `[..., E]`, or None.
            train: normalise batches by their own statistics and move the running ones.
        """
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
    scale = normalisation.make(spec, architecture.normalise_observation)
    return from_module(
        lambda variables, observation, **kwargs: mlp.apply(
            variables, scale(variables, observation), **kwargs
        ),
        lambda key: mlp.init(key, jnp.zeros((1, spec.observation_dim))) | scale.initial(),
    )


def critic(spec: EnvSpec, architecture: Architecture) -> Network:
    """An action-value function: observation `[..., O]`, action `[..., A]` -> value `[...]`.

    Raises:
        ValueError: if there is no layer number `action_layer`.
    """
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
    scale = normalisation.make(spec, architecture.normalise_observation)
    network = from_module(
        lambda variables, observation, action, **kwargs: mlp.apply(
            variables, scale(variables, observation), action, **kwargs
        ),
        lambda key: (
            mlp.init(key, jnp.zeros((1, spec.observation_dim)), jnp.zeros((1, spec.action_dim)))
            | scale.initial()
        ),
    )
    return scalar_output(network)


def make(spec: EnvSpec, architecture: Architecture | None = None) -> ActorCritic:
    """The actor, the critic and the squashing onto `spec`'s action bounds.

    Raises:
        ValueError: if the specification contradicts itself, or a number of the architecture is out
            of range.
    """
    architecture = architecture or Architecture()
    ranges.check(architecture)
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

    The mean is over pairs and dimensions of the action.

    Args:
        networks: the actor and the squashing.
        actor: its parameters.
        observation: `[B, O]`.
        action: `[B, A]`.
        counts: `[B]` bool; pairs that are False add zero to the mean, which stays a mean over all
            pairs. None: all are True.
    """
    pre_activation, actor = train_mode(networks.actor)(actor, observation)
    squared = jnp.square(networks.squash(pre_activation) - action)
    if counts is not None:
        squared = jnp.where(counts[:, None], squared, 0.0)
    return jnp.mean(squared), actor


def squashing(spec: EnvSpec) -> Callable[[jax.Array], jax.Array]:
    """Tanh onto the action bounds: `[..., A]` -> `[..., A]`.

    Raises:
        ValueError: if the specification contradicts itself.
    """
    checks.env_spec(spec)
    centre = jnp.asarray(0.5 * (spec.action_high + spec.action_low))
    half_width = jnp.asarray(0.5 * (spec.action_high - spec.action_low))
    return functools.partial(_squash, centre, half_width)


def _squash(centre: jax.Array, half_width: jax.Array, pre_activation: jax.Array) -> jax.Array:
    pre_activation, centre, half_width = modes.align(pre_activation, centre, half_width)
    return centre + half_width * jnp.tanh(pre_activation)


def from_module(apply: Callable[..., Any], init: Callable[[jax.Array], Params]) -> Network:
    """Wrap a Linen `apply` (which takes `train=` and `mutable=`) and `init` as a `Network`.

    The network gets a `train` function if its variables have a `batch_stats` collection.
    """
    has_statistics = "batch_stats" in jax.eval_shape(init, jax.random.key(0))
    return Network(init, apply, functools.partial(_train, apply) if has_statistics else None)


def _train(
    apply: Callable[..., Any], variables: Params, *inputs: jax.Array
) -> tuple[jax.Array, Params]:
    output, moved = apply(variables, *inputs, train=True, mutable=["batch_stats"])
    return output, {**variables, **moved}


def scalar_output(network: Network) -> Network:
    """Drop the last axis, of size one, from a network's output."""
    return Network(
        init=network.init,
        apply=lambda params, *inputs: network.apply(params, *inputs)[..., 0],
        train=None if network.train is None else functools.partial(_train_scalar, network.train),
    )


def _train_scalar(
    train: Callable[..., tuple[jax.Array, Params]], params: Params, *inputs: jax.Array
) -> tuple[jax.Array, Params]:
    output, params = train(params, *inputs)
    return output[..., 0], params


def train_mode(network: Network) -> Callable[..., tuple[jax.Array, Params]]:
    """`network.train`; without running statistics, `apply` and the parameters as they are."""
    if network.train is not None:
        return network.train
    return lambda params, *inputs: (network.apply(params, *inputs), params)


def _dense(units: int, bound: float) -> nn.Dense:
    """A dense layer whose kernel and bias are drawn from U(-bound, bound)."""

    initialise = functools.partial(jax.random.uniform, minval=-bound, maxval=bound)
    return nn.Dense(
        units,
        kernel_init=initialise,
        bias_init=initialise,
        dot_general=products.dot_general,
    )
