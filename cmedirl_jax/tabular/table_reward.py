"""A reward that was learned on a grid, as r_D for an agent in the continuous task (Eq. 10)."""

import functools

import jax
import jax.numpy as jnp

from cmedirl_jax import checks, ranges
from cmedirl_jax.hyperparameters import traced
from cmedirl_jax.irl import IRLHParams, RewardLearner, RewardState, base
from cmedirl_jax.tabular import interpolation
from cmedirl_jax.tabular.interpolation import Grid
from cmedirl_jax.types import Numeric


def make(states: Grid, actions: Grid, hparams: IRLHParams | None = None) -> RewardLearner:
    """Make a `RewardLearner` that learns nothing: its reward interpolates a table.

    Args:
        states: grid of the observations.
        actions: grid of the actions.
        hparams: only `bound` is read.

    Raises:
        ValueError: if the table is above `checks.LARGEST_ARRAY`.
    """
    size = (states.size, actions.size)
    checks.array_size("a table of rewards", size, "take fewer states or actions")
    return RewardLearner(
        init=functools.partial(_init, states, actions, hparams or IRLHParams()),
        reward=functools.partial(_reward, states, actions),
        update=base.learn_nothing,
    )


def _init(states: Grid, actions: Grid, hparams: IRLHParams, key: jax.Array) -> RewardState:
    del key
    table = jnp.zeros((states.size, actions.size), jnp.float32)
    return RewardState(table, (), traced(hparams))


def _reward(
    states: Grid, actions: Grid, state: RewardState, observation: jax.Array, action: jax.Array
) -> jax.Array:
    checks.shape("observation", observation, (*observation.shape[:-1], len(states.shape)))
    checks.shape("action", action, (*observation.shape[:-1], len(actions.shape)))
    row, row_weight = interpolation.interpolate(states, observation)
    column, column_weight = interpolation.interpolate(actions, action)
    values = state.params[row[..., :, None], column[..., None, :]]
    return jnp.einsum("...rc,...r,...c->...", values, row_weight, column_weight)


def state(
    table: jax.Array, visits: jax.Array, deviation: Numeric, hparams: IRLHParams
) -> RewardState:
    """The state that holds `table`, with mean 0 and this deviation where demonstrations go.

    Demonstrations do not determine the scale of a reward, nor a constant in it. A reward that is
    large beside the environment's makes staying alive better than finishing: entries beyond the
    bound are clipped. Dividing by the largest entry instead leaves hardly any contrast where the
    agent goes: the extremes lie in corners of the grid.

    Args:
        table: `[states.size, actions.size]`, without a row for the absorbing state.
        visits: `[states.size]`, how much demonstrations visit each state. The actions in a state
            weigh alike.
        deviation: of the reward over these states, in units of the environment's reward.
        hparams: only `bound` is read.

    Raises:
        ValueError: if a known entry is not finite, a known visit is negative, the shapes do not
            agree, or the deviation or the bound is out of range.
        TypeError: if the table is not of floats.
    """
    checks.kind("table", table, jnp.floating)
    checks.within(ranges.FINITE, table=table)
    checks.shape("visits", visits, jnp.shape(table)[:1])
    checks.within(ranges.NOT_NEGATIVE, visits=visits)
    checks.positive(deviation=deviation)
    ranges.check(hparams)
    table = jnp.asarray(table, jnp.float32)
    weight = jnp.broadcast_to(visits[:, None] / (jnp.sum(visits) * table.shape[1]), table.shape)
    centred = table - jnp.sum(weight * table)
    found = jnp.sqrt(jnp.sum(weight * jnp.square(centred)))
    scaled = deviation * centred / jnp.where(found > 0, found, 1.0)
    return RewardState(jnp.clip(scaled, -hparams.bound, hparams.bound), (), traced(hparams))
