"""Networks for the learned reward r_D(s, a; theta) (the paper, section 2.2)."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import networks
from cmedirl_jax.types import EnvSpec, Network


def mlp(spec: EnvSpec, hidden: tuple[int, ...] = (64, 64)) -> Network:
    """A deep reward: observation `[..., O]`, action `[..., A]` -> `[...]`, before any bound.

    The critic's shape without its normalisation: the observation, scaled to [-1, 1], and the action
    joined at the input.
    """
    return networks.critic(spec, networks.Architecture(hidden=hidden, critic_normalisation="none"))


def radial_basis(
    spec: EnvSpec, centres: int
) -> Callable[[jax.Array | np.ndarray, jax.Array | np.ndarray], jax.Array]:
    """phi(s, a) for a linear reward theta^T phi (Eq. 1): `[..., O]`, `[..., A]` -> `[..., F]`.

    Gaussians of the observation on a regular grid of `centres` per dimension over its bounds, as
    wide as they lie apart and normalised to sum to one; times 1, a and a^2 of each action, so that
    the reward is a quadratic of the action whose coefficients vary over the states.

    Raises:
        ValueError: if there are fewer than two centres, or the observation has an infinite bound.
    """
    if centres < 2:
        raise ValueError(f"radial basis functions need two centres or more, got {centres}")
    scale = networks.observation_scaling(spec)
    axis = np.linspace(-1.0, 1.0, centres)
    grid = np.stack(np.meshgrid(*[axis] * spec.observation_dim, indexing="ij"), axis=-1)
    width = axis[1] - axis[0]

    def features(observation, action):
        away = (scale(observation)[..., None, :] - grid.reshape(-1, spec.observation_dim)) / width
        local = jax.nn.softmax(-0.5 * jnp.sum(jnp.square(away), axis=-1), axis=-1)
        of_action = jnp.concatenate(
            [jnp.ones_like(action[..., :1]), action, jnp.square(action)], axis=-1
        )
        both = local[..., :, None] * of_action[..., None, :]
        return both.reshape(*both.shape[:-2], -1)

    return features


def bounded(output, bound):
    """`bound * tanh(output)`, which keeps |r_D| < bound; `bound` = inf leaves it unbounded.

    A constant in r_D is not identified by the demonstrations but changes the policy of an episodic
    task, so an unbounded r_D can make loitering better than finishing.
    """
    finite = jnp.where(jnp.isinf(bound), 1.0, bound)
    return jnp.where(jnp.isinf(bound), output, finite * jnp.tanh(output))
