"""Demonstrations in a finite Markov decision process: what they visited, and what they must be.

The maximum-entropy distribution gives probability to the trajectories of the process alone: their
transitions are possible, and they end after the last step of the horizon or in an absorbing state.
For any others no reward makes E[mu] equal to mu_D, and the objective has no maximum.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, ranges
from cmedirl_jax.tabular import dynamics as dynamics_lib
from cmedirl_jax.tabular.dynamics import Dynamics
from cmedirl_jax.types import Array, Numeric

_REMEDY = (
    "mark in absorbing= the states in which episodes end (add one, if the dynamics have none), or "
    "cut all demonstrations to one length and pass it as horizon="
)


class Steps(NamedTuple):
    """The steps of `N` demonstrations, padded to `T`.

    Attributes:
        state: `[N, T]` int.
        action: `[N, T]` int.
        mask: `[N, T]` bool, False past a demonstration's end; its first step is never past it.
    """

    state: Any
    action: Any
    mask: Any


class TabularDemonstrations(NamedTuple):
    """The visits and the starts of the demonstrations.

    Attributes:
        visitation: `[S, A]`, mu_D(s, a) = 1/N sum_i sum_t gamma^t 1[(s_t, a_t) = (s, a)].
        initial: `[S]`, the distribution of their first states.
        steps: what was counted; None if that is not known.
    """

    visitation: jax.Array
    initial: jax.Array
    steps: Steps | None = None


def empirical_visitation(
    state: Array, action: Array, mask: Array, size: tuple[int, int], *, discount: Numeric
) -> TabularDemonstrations:
    """Count demonstrations: mu_D and D_0.

    Args:
        state: `[N, T]` int.
        action: `[N, T]` int.
        mask: `[N, T]` bool, False past a demonstration's end; its first step is never past it.
        size: (S, A).
        discount: gamma, per step, between 0 and 1.

    Raises:
        ValueError: if the shapes differ or are empty; if a known state or action does not exist, a
            demonstration has no step or a gap, or the discount is out of range.
        TypeError: if the states and actions are not integers, or the mask is not bool.
    """
    checks.sizes(**dict(zip(("size[0]", "size[1]"), size, strict=True)))
    checks.shares(discount=discount)
    _check_steps(Steps(state, action, mask), size)
    n, length = jnp.shape(mask)
    discounts = jnp.asarray(discount) ** jnp.arange(length)
    weight = jnp.asarray(mask) * discounts[None] / n
    return TabularDemonstrations(
        jnp.zeros(size, weight.dtype).at[state, action].add(weight),
        jnp.zeros(size[0], weight.dtype).at[jnp.asarray(state)[:, 0]].add(1.0 / n),
        Steps(state, action, mask),
    )


def _check_steps(steps: Steps, size: tuple[int, int]) -> None:
    shape = jnp.shape(steps.mask)
    if len(shape) != 2 or 0 in shape:
        raise ValueError(f"mask: expected [N, T] with N > 0 and T > 0, got shape {shape}")
    checks.kind("mask", steps.mask, jnp.bool_)
    checks.shape("state", steps.state, shape)
    checks.shape("action", steps.action, shape)

    # Padding may hold anything.
    mask = np.asarray(steps.mask) if ranges.known(steps.mask) else None
    for name, index, count in zip(("state", "action"), steps, size, strict=False):
        checks.kind(name, index, jnp.integer)
        if mask is not None and ranges.known(index):
            checks.indices(count, **{name: np.where(mask, index, 0)})
    if mask is not None and not mask[:, 0].all():
        raise ValueError(f"demonstration {np.argmin(mask[:, 0])} has no first step in the mask")
    if mask is not None and (mask[:, 1:] > mask[:, :-1]).any():
        gap = np.argwhere(mask[:, 1:] > mask[:, :-1])[0]
        raise ValueError(f"mask: demonstration {gap[0]} goes on after a gap, at step {gap[1] + 1}")


def check(
    demonstrations: TabularDemonstrations,
    dynamics: Dynamics,
    *,
    discount: Numeric,
    horizon: int | None,
    absorbing: Array | None,
) -> None:
    """Check that demonstrations are trajectories of the process, as far as values are known.

    Args:
        demonstrations: their visits, and their steps if known.
        dynamics: P(s'|s,a).
        discount: gamma, at which the visits are counted.
        horizon: steps of an episode; None: no limit.
        absorbing: `[S]` bool, the states in which an episode is over.

    Raises:
        ValueError: if visits are negative or not finite, are made in an absorbing state, or do not
            have the sum that the discount gives; if a demonstration makes an impossible transition,
            is longer than the horizon, or ends before it where no absorbing state can follow.
        TypeError: if the visits are not floats.
    """
    checks.kind("visitation", demonstrations.visitation, jnp.floating)
    checks.within(ranges.NOT_NEGATIVE, visitation=demonstrations.visitation)
    values = jax.tree.leaves((demonstrations, dynamics, discount, absorbing))
    if not all(map(ranges.known, values)):
        return
    visitation, discount = np.asarray(demonstrations.visitation), float(discount)
    over = np.flatnonzero([] if absorbing is None else absorbing)
    if visitation[over].any():
        state = over[np.argmax(visitation[over].any(axis=1))]
        raise ValueError(f"visitation: the demonstrations act in state {state}, which is absorbing")
    if demonstrations.steps is None:
        _check_sum(visitation, discount, horizon, bool(over.size))
        return
    steps = Steps(*map(np.asarray, demonstrations.steps))
    _check_counted(visitation, steps, discount)
    _check_transitions(steps, dynamics)
    _check_ends(steps, dynamics, discount, horizon, over)


def _check_sum(visitation: np.ndarray, discount: float, horizon: int | None, may_end: bool) -> None:
    """Check sum_{s,a} mu(s, a) where it is not known what was counted."""
    most = 1.0 / (1.0 - discount) if horizon is None else np.sum(discount ** np.arange(horizon))
    total = np.sum(visitation)
    # What `expected_visitation` gives without a horizon has the tolerance of its fixed point.
    if total > 1.01 * most or (total < 0.99 * most and not may_end):
        raise ValueError(
            f"visitation sums to {total:.6g}, expected {'at most ' if may_end else ''}{most:.6g} "
            f"at discount {discount:g} and horizon {horizon}: count all steps at that discount, or "
            f"{_REMEDY}"
        )


def _check_counted(visitation: np.ndarray, steps: Steps, discount: float) -> None:
    counted = np.sum(steps.mask * discount ** np.arange(steps.mask.shape[1])) / len(steps.mask)
    # Visits are counted in float32, one by one.
    if not np.isclose(np.sum(visitation), counted, rtol=1e-2):
        raise ValueError(
            f"visitation sums to {np.sum(visitation):.6g}, expected {counted:.6g} at discount "
            f"{discount:g}: count the demonstrations at the same discount"
        )


def _check_transitions(steps: Steps, dynamics: Dynamics) -> None:
    row, time = np.nonzero(steps.mask[:, 1:])
    state, action, following = (
        steps.state[row, time],
        steps.action[row, time],
        steps.state[row, time + 1],
    )
    impossible = dynamics_lib.probability_of(dynamics, state, action, following[:, None]) <= 0
    if impossible.any():
        i = np.argmax(impossible)
        raise ValueError(
            f"demonstration {row[i]} goes from state {state[i]} to {following[i]} by action "
            f"{action[i]} at step {time[i]}, to which the dynamics give probability 0"
        )


def _check_ends(
    steps: Steps, dynamics: Dynamics, discount: float, horizon: int | None, over: np.ndarray
) -> None:
    length = np.sum(steps.mask, axis=1)
    if horizon is not None and length.max() > horizon:
        raise ValueError(
            f"demonstration {np.argmax(length)} has {length.max()} steps, the horizon is {horizon}"
        )
    row = np.arange(len(length))
    state, action = steps.state[row, length - 1], steps.action[row, length - 1]
    successors = np.broadcast_to(over, (len(row), len(over)))
    may_end = dynamics_lib.probability_of(dynamics, state, action, successors) > 0
    # Without a horizon, what follows counts no more once its weight is lost in rounding.
    far = discount**length < np.finfo(np.float32).eps if horizon is None else length == horizon
    if not (may_end | far).all():
        i = np.argmin(may_end | far)
        of = "" if horizon is None else f" of {horizon}"
        raise ValueError(
            f"demonstration {i} ends after {length[i]}{of} steps by action {action[i]} in state "
            f"{state[i]}, which leads to no absorbing state: {_REMEDY}"
        )
