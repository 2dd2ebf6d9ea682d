"""A reward that was learned on a grid, as r_D for an agent in the continuous task (Eq. 10)."""

import functools

import jax
import jax.numpy as jnp

from cmedirl_jax import checks, ranges
from cmedirl_jax.irl import IRLHParams, RewardLearner, RewardState, base
from cmedirl_jax.optimizers import traced
from cmedirl_jax.tabular import interpolation
from cmedirl_jax.tabular.interpolation import Grid


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
    return state(jnp.zeros((states.size, actions.size), jnp.float32), hparams)


def _reward(
    states: Grid, actions: Grid, state: RewardState, observation: jax.Array, action: jax.Array
) -> jax.Array:
    checks.shape("observation", observation, (*observation.shape[:-1], len(states.shape)))
    checks.shape("action", action, (*observation.shape[:-1], len(actions.shape)))
    row, row_weight = interpolation.interpolate(states, observation)
    column, column_weight = interpolation.interpolate(actions, action)
    values = state.params[row[..., :, None], column[..., None, :]]
    return jnp.einsum("...rc,...r,...c->...", values, row_weight, column_weight)


def state(table: jax.Array, hparams: IRLHParams) -> RewardState:
    """The state that holds `table`, scaled so that its largest magnitude is the bound.

    Demonstrations do not determine the scale of a reward. A reward that is large beside the
    environment's makes staying alive better than finishing.

    Args:
        table: `[states.size, actions.size]`, without a row for the absorbing state.
        hparams: only `bound` is read.

    Raises:
        ValueError: if a known entry is not finite, or the bound is out of range.
        TypeError: if the table is not of floats.
    """
    checks.kind("table", table, jnp.floating)
    checks.within(ranges.FINITE, table=table)
    ranges.check(hparams)
    table = jnp.asarray(table, jnp.float32)
    largest = jnp.max(jnp.abs(table))
    scaled = hparams.bound * table / jnp.where(largest > 0, largest, 1.0)
    return RewardState(scaled, (), traced(hparams))
