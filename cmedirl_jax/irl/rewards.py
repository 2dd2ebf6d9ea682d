"""Networks for the learned reward r_D(s, a; theta), deep or linear (the paper, section 2.2, Eq. 1).

    network = rewards.linear(spec, rewards.fourier(spec, order=3))

All take an observation `[..., O]` and an action `[..., A]`, floats with the same leading axes; they
raise ValueError for other shapes and TypeError for other dtypes. With inputs "state" they ignore
the action.

A new kind of network needs, all in this file: its function, its fields in `RewardNetworkSettings`,
its name in `NetworkName`, and an entry in `NETWORKS`.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, grids, modes, networks, normalisation, ranges
from cmedirl_jax.normalisation import Normalise
from cmedirl_jax.ranges import AtLeastTwo, Size
from cmedirl_jax.registries import Registry
from cmedirl_jax.types import Array, EnvSpec, Network, Params

Inputs = Literal["state-action", "state"]
"""Whether a reward is r(s, a) or r(s)."""

Features = Callable[[Array, Array], jax.Array]
"""phi: observation `[..., O]`, action `[..., A]` -> `[..., F]`."""

NetworkName = Annotated[Literal["deep", "radial-basis", "fourier"], ranges.Registered]
"""The names in `NETWORKS`."""


_FEWER_CENTRES, _LOWER_ORDER = "take fewer centres", "take a lower order"


@dataclasses.dataclass(frozen=True)
class RewardNetworkSettings:
    """The reward network. All static.

    Attributes:
        kind: A perceptron, or theta^T phi (Eq. 1) with one of two kinds of features.
        inputs: r(s, a), or r(s).
        hidden: Units of each hidden layer of a deep reward.
        centres: Radial basis functions along each dimension of the observation.
        order: Highest frequency of the Fourier basis along each dimension of its inputs, in half
            periods of the input's range.
    """

    kind: NetworkName = "deep"
    inputs: Inputs = "state-action"
    hidden: tuple[Size, ...] = (64, 64)
    centres: AtLeastTwo = 9
    order: Size = 3


class NetworkKind(NamedTuple):
    """All that belongs to the name of a kind of reward network.

    Attributes:
        make: `(spec, settings, inputs, normalise) -> Network`; of the settings it reads its own
            fields.
        starts_at_zero: whether its first parameters give r_D = 0 everywhere, so that it cannot be
            the network of a random reward.
    """

    make: Callable[[EnvSpec, RewardNetworkSettings, Inputs, Normalise], Network]
    starts_at_zero: bool = False


def make(
    spec: EnvSpec,
    settings: RewardNetworkSettings | None = None,
    *,
    state_only: bool = False,
    normalise: Normalise = "bounds",
) -> Network:
    """The network that `settings.kind` names, before any bound.

    Args:
        spec: the environment's sizes and bounds.
        settings: the kind, and its sizes.
        state_only: make r(s), as a potential needs, whatever `settings.inputs` says.
        normalise: how a deep reward normalises observations; the others need bounds.

    Raises:
        ValueError: for an unknown kind or a setting out of range, and as the kind's own function:
            `mlp`, `radial_basis` or `fourier`.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    settings = settings or RewardNetworkSettings()
    ranges.check(settings)
    inputs = "state" if state_only else settings.inputs
    return NETWORKS[settings.kind].make(spec, settings, inputs, normalise)


def mlp(
    spec: EnvSpec,
    hidden: tuple[int, ...] = (64, 64),
    inputs: Inputs = "state-action",
    normalise: Normalise = "bounds",
) -> Network:
    """A deep reward: observation `[..., O]`, action `[..., A]` -> `[...]`, before any bound.

    It is the critic's network without normalisation of its layers: the observation is normalised as
    `normalise` says, and the action joins at the input. With inputs "state" it is the actor's
    network with one output.

    Raises:
        ValueError: if the specification contradicts itself, or for an unknown `normalise`.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    architecture = networks.Architecture(
        hidden=hidden, critic_normalisation="none", normalise_observation=normalise
    )
    if inputs == "state-action":
        network = networks.critic(spec, architecture)
        return network._replace(apply=functools.partial(_apply_to_pairs, spec, network))
    one = spec._replace(
        action_dim=1, action_low=spec.action_low[:1], action_high=spec.action_high[:1]
    )
    network = networks.scalar_output(networks.actor(one, architecture))
    return network._replace(apply=functools.partial(_apply_to_states, spec, network))


def _apply_to_pairs(
    spec: EnvSpec, network: Network, params: Params, observation: Array, action: Array
) -> jax.Array:
    checks.pairs(spec, observation, action)
    return network.apply(params, observation, action)


def _apply_to_states(
    spec: EnvSpec, network: Network, params: Params, observation: Array, action: Array
) -> jax.Array:
    del action
    checks.pairs(spec, observation)
    return network.apply(params, observation)


def linear(spec: EnvSpec, features: Features) -> Network:
    """theta^T phi (Eq. 1): observation `[..., O]`, action `[..., A]` -> `[...]`; theta is `[F]`.

    It starts from theta = 0 and ignores the key: there is no symmetry to break, and a reward of
    zero has no preference. Without a bound the likelihood is concave in theta.

    Raises:
        ValueError: if the specification contradicts itself.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    size = jax.eval_shape(features, spec.observation_low, spec.action_low).shape[-1]
    return Network(
        init=lambda key: jnp.zeros(size, jnp.float32),
        apply=lambda theta, observation, action: features(observation, action) @ theta,
    )


def radial_basis(spec: EnvSpec, centres: int, inputs: Inputs = "state-action") -> Features:
    """Features of a linear reward (Eq. 1): `centres^O` Gaussians of the observation.

    They lie on a regular grid over the observation's bounds, `centres` along each dimension. Their
    width is the grid's spacing, and they are normalised to sum to one. With inputs "state-action"
    they are multiplied by 1, a and a^2 of each action, which makes the reward a quadratic function
    of the action whose coefficients vary over the states.

    Raises:
        ValueError: if the specification contradicts itself, there are fewer than two centres, the
            observation has a bound beyond 1e6, or the grid, or later the features of a batch, are
            above `checks.LARGEST_ARRAY`.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    if centres < 2:
        raise ValueError(f"radial basis functions need two centres or more, got {centres}")
    scale, dims = normalisation.by_bounds(spec), spec.observation_dim
    checks.array_size("radial basis functions", (*[centres] * dims, dims), _FEWER_CENTRES)
    axis = np.linspace(-1.0, 1.0, centres)
    grid = grids.product(*[axis] * dims)
    width = np.float32(axis[1] - axis[0])
    return functools.partial(_radial_basis, spec, inputs, scale, grid.astype(np.float32), width)


def _radial_basis(
    spec: EnvSpec,
    inputs: Inputs,
    scale: Callable[[jax.Array], jax.Array],
    grid: np.ndarray,
    width: np.float32,
    observation: Array,
    action: Array,
) -> jax.Array:
    checks.pairs(spec, observation, None if inputs == "state" else action)
    size = (*observation.shape[:-1], len(grid), 1 if inputs == "state" else 1 + 2 * spec.action_dim)
    checks.array_size("radial basis functions", size, _FEWER_CENTRES)
    position, centres = modes.align(scale(jnp.asarray(observation))[..., None, :], grid)
    away = (position - centres) / width
    local = jax.nn.softmax(-0.5 * jnp.sum(jnp.square(away), axis=-1), axis=-1)
    if inputs == "state":
        return local
    of_action = jnp.concatenate(
        [jnp.ones_like(action[..., :1]), action, jnp.square(action)], axis=-1
    )
    both = local[..., :, None] * of_action[..., None, :]
    return both.reshape(*both.shape[:-2], -1)


def fourier(spec: EnvSpec, order: int, inputs: Inputs = "state-action") -> Features:
    """Features of a linear reward (Eq. 1): the Fourier basis of Konidaris et al. (2011).

    The features are cos(pi c.x) for every c in {0, ..., order}^d, the last dimension fastest. x are
    the `d` inputs scaled to [0, 1]: the observation, and then the action.

    Raises:
        ValueError: if the specification contradicts itself, the order is less than one, the
            observation has a bound beyond 1e6, or the frequencies, or later the features of a
            batch, are above `checks.LARGEST_ARRAY`.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    if order < 1:
        raise ValueError(f"a Fourier basis needs an order of one or more, got {order}")
    low, high = spec.observation_low, spec.observation_high
    if inputs == "state-action":
        low, high = np.append(low, spec.action_low), np.append(high, spec.action_high)
    normalisation.by_bounds(spec)
    checks.array_size("a Fourier basis", (*[order + 1] * len(low), len(low)), _LOWER_ORDER)
    frequencies = np.pi * grids.product(*[np.arange(order + 1.0)] * len(low))
    return functools.partial(_fourier, spec, inputs, low, high, frequencies.astype(np.float32))


def _fourier(
    spec: EnvSpec,
    inputs: Inputs,
    low: np.ndarray,
    high: np.ndarray,
    frequencies: np.ndarray,
    observation: Array,
    action: Array,
) -> jax.Array:
    checks.pairs(spec, observation, None if inputs == "state" else action)
    if inputs == "state-action":
        observation = jnp.concatenate([observation, action], axis=-1)
    size = (*observation.shape[:-1], len(frequencies))
    checks.array_size("a Fourier basis", size, _LOWER_ORDER)
    position, least, width = modes.align(observation, low, high - low)
    x, c = modes.align(((position - least) / width)[..., None, :], frequencies)
    return jnp.cos(jnp.sum(x * c, axis=-1))


NETWORKS: Registry[NetworkKind] = Registry(
    "kind of reward network",
    {
        "deep": NetworkKind(
            lambda spec, settings, inputs, normalise: mlp(spec, settings.hidden, inputs, normalise)
        ),
        "radial-basis": NetworkKind(
            lambda spec, settings, inputs, normalise: linear(
                spec, radial_basis(spec, settings.centres, inputs)
            ),
            starts_at_zero=True,
        ),
        "fourier": NetworkKind(
            lambda spec, settings, inputs, normalise: linear(
                spec, fourier(spec, settings.order, inputs)
            ),
            starts_at_zero=True,
        ),
    },
)
"""Maps each name to its kind of reward network."""
