"""Trajectories of any numbers become pools; what does not fit is refused by its place."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.data import demonstrations
from tests.support import pools

SPEC = pools.ENV.spec
WHOLE = {
    "observations": [[0, 0], [1, 0], [2, 0]],
    "actions": [[0.5], [0.25]],
    "rewards": [1, 2],
    "terminated": True,
}


@given(lengths=st.lists(st.integers(1, 5), min_size=1, max_size=5), last=st.booleans())
def test_every_step_is_there_once(lengths, last):
    trajectories = [
        {
            "observations": np.arange(2 * (length + 1)).reshape(-1, 2) + 10.0 * index,
            "actions": np.full((length, 1), index / 10),
            "rewards": np.arange(length),
            "terminated": index % 2 == 0,
        }
        for index, length in enumerate(lengths)
    ]
    if last:
        trajectories[-1] |= {"terminated": False, "truncated": False}
    pool = demonstrations.from_trajectories(trajectories, SPEC.id)
    demonstrations.validate(pool)
    assert demonstrations.episodes(pool).length.tolist() == lengths
    ends = np.cumsum(lengths) - 1
    over = pool.transition.terminated | pool.truncated
    assert np.flatnonzero(over).tolist() == ends[: len(ends) - last].tolist()
    within = np.flatnonzero(~over[:-1] & (np.diff(pool.episode) == 0))
    np.testing.assert_array_equal(
        pool.transition.next_observation[within], pool.transition.observation[within + 1]
    )
    assert "absent" not in pool.metadata


def test_a_successor_that_nobody_observed_is_the_last_observation():
    short = WHOLE | {"observations": WHOLE["observations"][:2]}
    pool = demonstrations.from_trajectories([WHOLE, short], SPEC.id)
    assert pool.metadata == {"env": SPEC.id, "repeated_successors": 1}
    assert pool.transition.next_observation[1].tolist() == [2, 0]
    assert pool.transition.next_observation[3].tolist() == [1, 0]


@pytest.mark.parametrize(
    ("trajectories", "message"),
    [
        ([], "there are no trajectories"),
        ([WHOLE, {"actions": [[0.0]]}], "trajectory 1: it has no observations"),
        ([WHOLE | {"colour": 1}], "trajectory 0: unknown field 'colour'; there are observations"),
        (
            [WHOLE | {"rewards": [1]}],
            "trajectory 0: 3 observations, and .2, 1. actions and rew",
        ),
        ([WHOLE | {"observations": [[0, 0]]}], "1 observations for 2 steps: give 3"),
        ([WHOLE | {"actions": [["left"], ["up"]]}], "actions are <U4, not numbers"),
        ([WHOLE | {"actions": [0.5, 0.25]}], r"actions have shape \(2,\), not 2 axes"),
        ([WHOLE, WHOLE | {"rewards": None}], "trajectory 0 has rewards, trajectory 1 has none"),
        ([WHOLE | {"actions": [[0, 0], [0, 0]]}, WHOLE], "trajectories whose actions have shapes"),
        (
            [WHOLE | {"terminated": False, "truncated": False}, WHOLE],
            "trajectory 0: it neither terminated nor was truncated, and is not the last one",
        ),
        ([WHOLE | {"actions": None}], "without actions: give the task's specification"),
        (
            [{"observations": [[0, 0]], "rewards": None, "actions": None}],
            "trajectory 0: 1 observations, and",
        ),
    ],
)
def test_what_does_not_fit_is_refused_by_its_place(trajectories, message):
    with pytest.raises(ValueError, match=message):
        demonstrations.from_trajectories(trajectories, SPEC.id)


def test_numbers_that_no_float_holds_are_refused_when_they_are_read():
    huge = WHOLE | {"rewards": [1e300, 0.0]}
    with pytest.raises(ValueError, match="reward holds values that are not finite"):
        demonstrations.read([huge], env=SPEC)


@pytest.mark.parametrize(
    ("absent", "message"),
    [
        (["colour"], "absent in its metadata is .'colour'., no list of action and reward"),
        ("action", "absent in its metadata is 'action'"),
        (["reward"], "reward is absent by the metadata, and holds values"),
    ],
)
def test_what_is_absent_must_be(absent, message):
    pool = demonstrations.from_trajectories([WHOLE], SPEC.id, metadata={"absent": absent})
    with pytest.raises(ValueError, match=message):
        demonstrations.validate(pool)
