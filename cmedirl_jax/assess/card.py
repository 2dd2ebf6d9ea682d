"""What a learned reward knows of the true one: a number of each kind for each reward.

The rewards are parameters `[R, ...]` of one function; every result has a number for each of them.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.assess import coverage as coverage_lib
from cmedirl_jax.assess import distances, occupancy
from cmedirl_jax.assess.distances import Coverage
from cmedirl_jax.envs import Env
from cmedirl_jax.envs.base import step_from
from cmedirl_jax.tabular import interpolation
from cmedirl_jax.tabular.discretise import FiniteMDP
from cmedirl_jax.tabular.optimal_control import value_iteration
from cmedirl_jax.types import Numeric, Transition


class Rewards(NamedTuple):
    """Rewards of one form.

    Attributes:
        reward: `(params, observation [..., O], action [..., A]) -> [...]`.
        params: leaves `[R, ...]`.
    """

    reward: Callable[[Any, jax.Array, jax.Array], jax.Array]
    params: Any


class Truth(NamedTuple):
    """How far rewards are from the environment's own, leaves `[R]`.

    Attributes:
        epic: the EPIC distance, see `distances`.
        dard: the DARD distance.
        correlation: Pearson's, of r_D with the expected r_e of the compared states and actions.
    """

    epic: jax.Array
    dard: jax.Array
    correlation: jax.Array


class OnGrid(NamedTuple):
    """How far rewards are from the environment's own on a fine grid, leaves `[R]`.

    Attributes:
        starc: the STARC distance.
        advantage: Pearson's correlation of r_D with the advantage Q* - V* of the optimum.

    All states count alike that a step can lead to, and all actions.
    """

    starc: jax.Array
    advantage: jax.Array


class Told(NamedTuple):
    """How well rewards tell demonstrations from what a policy does, leaves `[R]`.

    Attributes:
        auc: the area under the ROC curve of r_D; 0.5: not at all.
        largest: the largest r_D of both.
        smallest: the smallest.
    """

    auc: jax.Array
    largest: jax.Array
    smallest: jax.Array


class Occupancies(NamedTuple):
    """How far what policies do is from demonstrations, leaves `[R]`; inputs in half-widths.

    Attributes:
        discrepancy: the maximum mean discrepancy of states and actions.
        wasserstein: their sliced Wasserstein distance.
    """

    discrepancy: jax.Array
    wasserstein: jax.Array


def truth(rewards: Rewards, env: Env, coverage: Coverage, discount: Numeric) -> Truth:
    """Compare rewards with the environment's own, each on a draw of its own of the coverage.

    The draws differ, so that what differs between rewards of equal quality is also their luck:
    where r_e is a rare bonus, few steps decide.

    Args:
        rewards: of states and actions.
        env: a task that can be set to an observation and draws nothing.
        coverage: the transitions to compare each reward on, leaves `[R, ...]`.
        discount: gamma.

    Raises:
        ValueError: if the task cannot be set to an observation.
    """
    follow = coverage_lib.successor(env)
    paid = _true_reward(env)

    def true(observation: jax.Array, action: jax.Array, after: jax.Array) -> jax.Array:
        del after
        return paid(observation, action)

    def compared(each: tuple[Any, Coverage]) -> Truth:
        params, own = each

        def learned(observation: jax.Array, action: jax.Array, after: jax.Array) -> jax.Array:
            del after
            return rewards.reward(params, observation, action)

        epic, dard = (
            distances.pearson(ours, theirs)
            for ours, theirs in zip(
                _forms(learned, follow, own, discount),
                _forms(true, follow, own, discount),
                strict=True,
            )
        )
        made = tuple(map(jnp.asarray, (own.observation, own.action, own.next_observation)))
        return Truth(epic, dard, _correlation(learned(*made), true(*made)))

    return jax.lax.map(compared, (rewards.params, coverage))


def _forms(
    reward: distances.Reward, follow: distances.Successor, coverage: Coverage, discount: Numeric
) -> tuple[jax.Array, jax.Array]:
    return (
        distances.epic(reward, coverage, discount),
        distances.dard(reward, follow, coverage, discount),
    )


def _true_reward(env: Env) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """r_e of observations `[..., O]` and actions `[..., A]`."""

    def paid(observation: jax.Array, action: jax.Array) -> jax.Array:
        return step_from(env, env.default_params, observation, action).reward

    return jnp.vectorize(paid, signature="(o),(a)->()")


def on_grid(rewards: Rewards, mdp: FiniteMDP, discount: Numeric) -> OnGrid:
    """Compare rewards with the environment's own on a grid.

    Args:
        rewards: of states and actions.
        mdp: the environment on the grid.
        discount: gamma.
    """
    states, actions = (
        jnp.asarray(interpolation.points(grid)) for grid in (mdp.states, mdp.actions)
    )
    pairs = jnp.broadcast_to(states[:, None], (len(states), len(actions), states.shape[1]))
    every_action = jnp.broadcast_to(actions[None], (len(states), *actions.shape))

    def table(params: Any) -> jax.Array:
        # The absorbing state pays nothing.
        return jnp.pad(rewards.reward(params, pairs, every_action), ((0, 1), (0, 0)))

    tables = jax.lax.map(table, rewards.params)
    forms = distances.starc(mdp.dynamics, jnp.concatenate([mdp.reward[None], tables]), discount)
    best = value_iteration(mdp.dynamics, mdp.reward, discount=discount, absorbing=mdp.absorbing)
    advantage = best.action_values - best.values[:, None]
    live = _live(mdp)
    # Correlations are of what is left after the mean over the pairs that count.
    weight = jnp.broadcast_to(live[:, None], advantage.shape)

    def centred(table: jax.Array) -> jax.Array:
        return table - jnp.sum(table * weight) / jnp.sum(weight)

    def correlation(table: jax.Array) -> jax.Array:
        apart = distances.normalised(centred(table), centred(advantage), live)
        return 1.0 - 2.0 * apart**2

    return OnGrid(distances.normalised(forms[1:], forms[:1], live), jax.vmap(correlation)(tables))


def _live(mdp: FiniteMDP) -> jax.Array:
    """`[S]` bool, the states that a step can lead to without an end."""
    chances = (
        jnp.zeros(len(mdp.absorbing)).at[mdp.dynamics.next_state].max(mdp.dynamics.probability)
    )
    return (chances > 0) & ~mdp.absorbing


def told(rewards: Rewards, demonstrated: Transition, played: Transition) -> Told:
    """How well rewards tell demonstrations from what policies do.

    Args:
        rewards: of states and actions.
        demonstrated: leaves `[R, N, ...]`, for each reward.
        played: leaves `[R, M, ...]`.
    """

    def one(params: Any, shown: Transition, acted: Transition) -> Told:
        ours, theirs = (
            rewards.reward(params, each.observation, each.action) for each in (shown, acted)
        )
        both = jnp.concatenate([ours, theirs])
        return Told(occupancy.area_under_roc(ours, theirs), jnp.max(both), jnp.min(both))

    return jax.vmap(one)(rewards.params, demonstrated, played)


def occupancies(
    key: jax.Array, scale: np.ndarray, demonstrated: Transition, played: Transition
) -> Occupancies:
    """How far what policies do is from demonstrations.

    Args:
        key: randomness, of the directions.
        scale: `[O + A]`, half the widths of observations and actions.
        demonstrated: leaves `[R, N, ...]`.
        played: leaves `[R, M, ...]`.
    """

    def points(each: Transition) -> jax.Array:
        return jnp.concatenate([each.observation, each.action], axis=-1) / scale

    def one(ours: jax.Array, theirs: jax.Array) -> Occupancies:
        return Occupancies(
            occupancy.maximum_mean_discrepancy(ours, theirs),
            occupancy.sliced_wasserstein(key, ours, theirs),
        )

    return jax.vmap(one)(points(demonstrated), points(played))


def loitering(discount: float, bonus: float) -> float:
    """The reward of a step above which never ending pays more than a bonus at the end.

    Args:
        discount: gamma.
        bonus: what the task pays as it ends.
    """
    return (1.0 - discount) * bonus / discount


def _correlation(ours: jax.Array, theirs: jax.Array) -> jax.Array:
    """Pearson's correlation; 0 where one does not vary."""
    return 1.0 - 2.0 * distances.pearson(ours, theirs) ** 2
