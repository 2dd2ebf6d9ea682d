"""Networks for the learned reward r_D(s, a; theta) (the paper, section 2.2)."""

import jax.numpy as jnp

from cmedirl_jax import networks
from cmedirl_jax.types import EnvSpec, Network


def mlp(spec: EnvSpec, hidden: tuple[int, ...] = (64, 64)) -> Network:
    """A deep reward: observation `[..., O]`, action `[..., A]` -> `[...]`, before any bound.

    The critic's shape without its normalisation: the observation, scaled to [-1, 1], and the action
    joined at the input.
    """
    return networks.critic(spec, networks.Architecture(hidden=hidden, critic_normalisation="none"))


def bounded(output, bound):
    """`bound * tanh(output)`, which keeps |r_D| < bound; `bound` = inf leaves it unbounded.

    A constant in r_D is not identified by the demonstrations but changes the policy of an episodic
    task, so an unbounded r_D can make loitering better than finishing.
    """
    finite = jnp.where(jnp.isinf(bound), 1.0, bound)
    return jnp.where(jnp.isinf(bound), output, finite * jnp.tanh(output))
