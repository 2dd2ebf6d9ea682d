"""A reward that was learned on a grid, as r_D for an agent in the continuous task (Eq. 10)."""

import jax
import jax.numpy as jnp

from cmedirl_jax import checks
from cmedirl_jax.irl import IRLHParams, RewardLearner, RewardState, base
from cmedirl_jax.optimizers import traced
from cmedirl_jax.tabular import interpolation
from cmedirl_jax.tabular.interpolation import Grid


def make(states: Grid, actions: Grid, hparams: IRLHParams | None = None) -> RewardLearner:
    """A `RewardLearner` that learns nothing: its reward is a table, interpolated.

    Args:
        states: grid of the observations.
        actions: grid of the actions.
        hparams: of which only `bound` is read.
    """
    hparams = hparams or IRLHParams()

    def init(key: jax.Array) -> RewardState:
        del key
        return state(jnp.zeros((states.size, actions.size)), hparams)

    def reward(state: RewardState, observation: jax.Array, action: jax.Array) -> jax.Array:
        checks.shape("observation", observation, (*observation.shape[:-1], len(states.shape)))
        checks.shape("action", action, (*observation.shape[:-1], len(actions.shape)))
        row, row_weight = interpolation.interpolate(states, observation)
        column, column_weight = interpolation.interpolate(actions, action)
        values = state.params[row[..., :, None], column[..., None, :]]
        return jnp.einsum("...rc,...r,...c->...", values, row_weight, column_weight)

    return RewardLearner(init, reward, base.learn_nothing)


def state(table: jax.Array, hparams: IRLHParams) -> RewardState:
    """The state that holds `table`, scaled so that its largest magnitude is the bound.

    The scale of a reward that explains demonstrations is arbitrary, and one that is large next to
    the environment's makes loitering better than finishing.

    Args:
        table: `[states.size, actions.size]`, without a row for the absorbing state.
        hparams: whose `bound`.
    """
    largest = jnp.max(jnp.abs(table))
    scaled = hparams.bound * table / jnp.where(largest > 0, largest, 1.0)
    return RewardState(scaled, (), traced(hparams))
