"""A reward that was learned on a grid, as r_D for an agent in the continuous task (Eq. 10)."""

import jax
import jax.numpy as jnp

from cmedirl_jax.irl import IRLHParams, RewardInfo, RewardLearner, RewardState
from cmedirl_jax.tabular import interpolation
from cmedirl_jax.tabular.interpolation import Grid
from cmedirl_jax.types import Transition


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
        row, row_weight = interpolation.interpolate(states, observation)
        column, column_weight = interpolation.interpolate(actions, action)
        values = state.params[row[..., :, None], column[..., None, :]]
        return jnp.einsum("...rc,...r,...c->...", values, row_weight, column_weight)

    def update(
        state: RewardState,
        demonstrations: Transition,
        background: Transition,
        *,
        key: jax.Array | None = None,
    ) -> tuple[RewardState, RewardInfo]:
        del demonstrations, background, key
        nothing = jnp.zeros(())
        return state, RewardInfo(nothing, nothing, nothing, nothing)

    return RewardLearner(init, reward, update)


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
    traced = jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)
    return RewardState(scaled, (), traced)
