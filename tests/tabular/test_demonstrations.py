import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import tabular
from cmedirl_jax.tabular import TabularDemonstrations
from tests.support import mdps

SIZE = (3, 2)
STATE = np.array([[0, 1, 1], [2, -1, 7]])
ACTION = np.array([[1, 0, 1], [1, 5, -1]])
MASK = np.array([[True, True, True], [True, False, False]])


def count(state=STATE, action=ACTION, mask=MASK, size=SIZE, discount=0.5):
    return tabular.empirical_visitation(state, action, mask, size, discount=discount)


@pytest.mark.parametrize("wrap", [lambda f: f, jax.jit], ids=["eager", "jit"])
def test_visits_are_counted_and_padding_may_hold_anything(wrap):
    counted = wrap(count)(STATE, ACTION, MASK)
    np.testing.assert_allclose(counted.visitation, [[0, 0.5], [0.25, 0.125], [0, 0.5]])
    np.testing.assert_allclose(counted.initial, [0.5, 0, 0.5])


@pytest.mark.parametrize(
    ("change", "error", "message"),
    [
        (
            {"state": np.where(STATE == 1, 3, STATE)},
            ValueError,
            r"state .* below 3, got 3 at .0, 1",
        ),
        ({"state": np.where(STATE == 2, -1, STATE)}, ValueError, r"state .*, got -1 at \[1, 0\]"),
        ({"action": np.where(STATE == 1, 2, ACTION)}, ValueError, r"action .* below 2, got 2 at"),
        ({"state": STATE * 1.0}, TypeError, "state: expected integers, got float32"),
        ({"state": STATE[:1]}, ValueError, r"state: expected shape \(2, 3\), got \(1, 3\)"),
        ({"action": ACTION[0]}, ValueError, r"action: expected shape \(2, 3\), got \(3,\)"),
        ({"mask": MASK * 0.5}, TypeError, "mask: expected bool, got float32"),
        ({"mask": MASK & (STATE < 2)}, ValueError, "demonstration 1 has no first step"),
        (
            {"mask": MASK & ~np.eye(2, 3, 1, bool)},
            ValueError,
            "demonstration 0 goes on after a gap",
        ),
        ({"mask": MASK[:0]}, ValueError, r"expected \[N, T\] with N > 0 .* \(0, 3\)"),
        ({"size": (0, 2)}, ValueError, r"size\[0\] must be at least 1, got 0"),
        ({"discount": 2.0}, ValueError, "discount must be between 0 and 1, got 2.0"),
        ({"discount": jnp.array(-0.5)}, ValueError, "discount must be between 0 and 1, got -0.5"),
        ({"discount": float("nan")}, ValueError, "discount must be between 0 and 1, got nan"),
    ],
)
def test_wrong_steps_are_refused_with_the_value(change, error, message):
    with pytest.raises(error, match=message):
        count(**change)


def test_many_demonstrations_from_one_state_are_a_distribution():
    """In float32, 100,000 times 1 / 100,000 is 1.001."""
    ones = np.ones((100_000, 1), bool)
    many = count(np.zeros_like(ones, int), np.ones_like(ones, int), ones)
    kwargs = {"discount": 0.5, "horizon": 1}
    jax.eval_shape(lambda: tabular.maxent_irl(np.ones((3, 2, 3)) / 3, np.eye(3), many, **kwargs))


CHAIN = np.zeros((4, 2, 4), np.float32)
"""Action 0 stays, action 1 goes on to the next state; the last state is a sink."""
for _state in range(4):
    CHAIN[_state, 0, _state] = CHAIN[_state, 1, min(_state + 1, 3)] = 1.0
LAST = np.arange(4) == 3
LONG = [(0, 0)] * 6 + [(0, 1), (1, 1)]
ENDED = [(0, 1), (1, 1), (2, 1)]
UNENDED = [(0, 1), (1, 1), (2, 0)]


def fit(demonstrations, dynamics=CHAIN, discount=0.9, **kwargs):
    if not isinstance(demonstrations, TabularDemonstrations):
        demonstrations = tabular.empirical_visitation(
            *mdps.padded(demonstrations, 200), (4, 2), discount=0.9
        )
    features = np.eye(4, dtype=np.float32)
    return tabular.maxent_irl(dynamics, features, demonstrations, discount=discount, **kwargs)


@pytest.mark.parametrize("dynamics", [CHAIN, mdps.sparse(CHAIN)], ids=["dense", "sparse"])
@pytest.mark.parametrize(
    ("demonstrations", "change", "message"),
    [
        (
            [LONG, ENDED],
            {"horizon": 8},
            "demonstration 1 ends after 3 of 8 steps by action 1 in st",
        ),
        ([LONG, UNENDED], {"horizon": 8, "absorbing": LAST}, "in state 2, which leads to no abs"),
        ([ENDED, UNENDED], {"absorbing": LAST}, "demonstration 1 ends after 3 steps by action 0"),
        ([ENDED, ENDED], {}, r"demonstration 0 ends .* mark in absorbing= .* pass it as horizon="),
        ([[(0, 0)] * 100], {}, "demonstration 0 ends after 100 steps"),
        ([ENDED, LONG], {"horizon": 7, "absorbing": LAST}, "1 has 8 steps, the horizon is 7"),
        ([[(0, 1), (2, 1)]], {"absorbing": LAST}, "0 goes from state 0 to 2 by action 1 at step 0"),
        ([[*ENDED, (3, 0)]], {"absorbing": LAST}, "act in state 3, which is absorbing"),
        (
            [ENDED],
            {"absorbing": LAST, "discount": 0.99},
            "sums to 2.71, expected 2.9701 at discount",
        ),
    ],
)
def test_demonstrations_of_another_process_are_refused(dynamics, demonstrations, change, message):
    with pytest.raises(ValueError, match=message):
        fit(demonstrations, dynamics, **change)


@pytest.mark.parametrize(
    ("visits", "change", "message"),
    [
        (5.0, {"horizon": 8}, r"sums to 5, expected 5\.69533 at discount 0\.9 and horizon 8"),
        (5.7, {"horizon": 5, "absorbing": LAST}, r"sums to 5\.7, expected at most 4\.0951"),
        (5.0, {}, r"sums to 5, expected 10 at discount 0\.9 and horizon None"),
        (np.nan, {}, "visitation must be at least 0 and finite, got nan"),
        (-1.0, {}, "visitation must be at least 0 and finite, got -1.0"),
    ],
)
def test_visits_that_no_trajectories_have_are_refused(visits, change, message):
    visitation = np.zeros((4, 2), np.float32)
    visitation[0, 0] = visits
    with pytest.raises(ValueError, match=message):
        fit(TabularDemonstrations(visitation, np.float32([1, 0, 0, 0])), **change)


@pytest.mark.parametrize(
    ("demonstrations", "change"),
    [
        ([LONG, ENDED], {"horizon": 8, "absorbing": LAST}),
        ([ENDED, [(0, 0), *ENDED]], {"absorbing": LAST}),
        ([LONG[:3], UNENDED], {"horizon": 3}),
        ([[(0, 0)] * 200], {}),
    ],
    ids=["horizon and end", "end", "horizon", "far"],
)
def test_trajectories_of_the_process_pass(demonstrations, change):
    jax.eval_shape(functools.partial(fit, demonstrations, **change))
