"""What a reward looks at, and whether rewards agree with each other."""

import jax
import jax.numpy as jnp

from cmedirl_jax.assess import distances
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.types import Transition


def permutation(key: jax.Array, rewards: Rewards, steps: Transition) -> jax.Array:
    """How much each reward depends on each of its inputs: `[R, O + A]`.

    It is the root mean square of how much r_D changes when one input is exchanged among the steps,
    over sqrt(2) of its standard deviation (Breiman 2001, with the reward's own values in place of
    an error): 1 for a reward of that input alone, 0 for one that does not read it, or is constant;
    above 1 where the exchange leaves what was visited, and r_D varies more there.

    Args:
        key: randomness, of the permutations.
        rewards: of states and actions.
        steps: leaves `[R, N, ...]`, for each reward.
    """
    size = steps.observation.shape[-1]

    def one(params: jax.Array, own: Transition) -> jax.Array:
        inputs = jnp.concatenate([own.observation, own.action], axis=-1)

        def paid(inputs: jax.Array) -> jax.Array:
            return rewards.reward(params, inputs[:, :size], inputs[:, size:])

        def change(key: jax.Array, column: jax.Array) -> jax.Array:
            other = jax.random.permutation(key, inputs)
            mixed = jnp.where(jnp.arange(inputs.shape[1]) == column, other, inputs)
            return jnp.sqrt(jnp.mean(jnp.square(paid(mixed) - paid(inputs))) / 2.0)

        columns = jnp.arange(inputs.shape[1])
        keys = jax.random.split(key, len(columns))
        deviation = jnp.std(paid(inputs))
        changes = jax.vmap(change)(keys, columns)
        return jnp.where(deviation > 0, changes / jnp.where(deviation > 0, deviation, 1.0), 0.0)

    return jax.lax.map(lambda each: one(*each), (rewards.params, steps))


def disagreement(rewards: Rewards, steps: Transition) -> jax.Array:
    """Pearson's distance between every two rewards on the same steps: `[R, R]`.

    0: equal up to scale and constant; 0.71: unrelated; 1: opposite.

    Args:
        rewards: of states and actions.
        steps: leaves `[N, ...]`, which all of them are compared on.
    """
    paid = jax.lax.map(
        lambda params: rewards.reward(params, steps.observation, steps.action), rewards.params
    )
    return jax.lax.map(
        lambda one: jax.vmap(lambda other: distances.pearson(one, other))(paid), paid
    )
