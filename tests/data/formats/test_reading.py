"""Formats of demonstrations x what theirs may lack: each reads what each can say."""

import os

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cmedirl_jax.data import demonstrations
from tests.support import damages, pools
from tests.support.formats import (
    EACH,
    NO_ENDS,
    OTHER_FILES,
    SPEC,
    WRITERS,
    as_csv,
    as_parquet,
    assert_steps,
    episodes,
)

ENV = pools.ENV


def in_formats(but=()):
    """Once for each format that can hold what a test asks for."""
    those = [(name, write) for name, write in EACH if name not in but]
    return pytest.mark.parametrize(("name", "write"), those, ids=[name for name, _ in those])


@in_formats()
def test_it_is_recognised_and_read(name, write, tmp_path):
    trajectories = episodes()
    source = write(trajectories, tmp_path / "pool")
    pool = demonstrations.read(source, env=SPEC)
    assert_steps(pool, trajectories)
    assert pool.metadata["env"] == SPEC.id
    ends = np.cumsum([3, 1, 4]) - 1
    assert np.flatnonzero(pool.truncated).tolist() == ends.tolist()
    if name in NO_ENDS:
        assert pool.metadata["repeated_successors"] == 3
    else:
        successors = np.concatenate([each["observations"][1:] for each in trajectories])
        np.testing.assert_allclose(pool.transition.next_observation, successors, rtol=1e-6)
    assert demonstrations.read(source, name.split()[0], env=SPEC).metadata == pool.metadata


@in_formats(but=NO_ENDS)
def test_terminations_are_told_from_truncations(name, write, tmp_path):
    trajectories = episodes()
    trajectories[1]["terminated"] = True
    pool = demonstrations.read(write(trajectories, tmp_path / "pool"), env=SPEC)
    assert np.flatnonzero(pool.transition.terminated).tolist() == [3]
    assert np.flatnonzero(pool.truncated).tolist() == [2, 7]


@in_formats()
def test_a_last_episode_may_be_unfinished(name, write, tmp_path):
    trajectories = episodes()
    trajectories[-1]["truncated"] = False
    pool = demonstrations.read(write(trajectories, tmp_path / "pool"), env=SPEC)
    told = name.split()[0] in ("trajectories", "table", "npz", "d4rl", "d4rl-file")
    assert np.flatnonzero(pool.truncated).tolist() == ([2, 3] if told else [2, 3, 7])


@in_formats(but=["minari"])
def test_what_is_missing_the_task_computes_or_the_pool_lacks(name, write, tmp_path):
    trajectories = episodes()
    paid = [each["rewards"] for each in trajectories]
    for each in trajectories:
        each["rewards"] = None
    source = write(trajectories, tmp_path / "pool")
    # Held to a specification: absent, and said so.
    pool = demonstrations.read(source, env=SPEC)
    assert pool.metadata["absent"] == ["reward"]
    assert np.isnan(pool.transition.reward).all()
    # Read with the task itself: its own rewards, and what was observed last.
    whole = demonstrations.read(source, env=ENV)
    assert whole.metadata["absent"] == []
    assert "reward" in whole.metadata["computed"]
    np.testing.assert_allclose(whole.transition.reward, np.concatenate(paid), rtol=1e-5)
    successors = np.concatenate([each["observations"][1:] for each in trajectories])
    np.testing.assert_allclose(whole.transition.next_observation, successors, atol=1e-6)
    assert ("next_observation" in whole.metadata["computed"]) == (name in NO_ENDS)
    demonstrations.check(whole, ENV)


@in_formats()
def test_whole_rewards_are_floats(name, write, tmp_path):
    trajectories = episodes()
    for each in trajectories:
        each["rewards"] = np.arange(len(each["rewards"]))
    pool = demonstrations.read(write(trajectories, tmp_path / "pool"), env=SPEC)
    assert pool.transition.reward.tolist() == [0, 1, 2, 0, 0, 1, 2, 3]
    assert pool.transition.reward.dtype == np.float32


@in_formats()
def test_actions_out_of_bounds_are_refused_or_clipped(name, write, tmp_path):
    trajectories = episodes()
    trajectories[0]["actions"] = np.array([[1.0001], [-1.5], [0.3]])
    source = write(trajectories, tmp_path / "pool")
    with pytest.raises(ValueError, match=r"episode 0, step 0: action\[0\] is 1.0001"):
        demonstrations.read(source, env=SPEC)
    clipped = demonstrations.read(source, env=SPEC, actions="clip")
    np.testing.assert_allclose(clipped.transition.action[:3, 0], [1.0, -1.0, 0.3])


@pytest.mark.parametrize("write", [as_csv, as_parquet, WRITERS["trajectories"]])
def test_demonstrations_may_have_no_actions(write, tmp_path):
    trajectories = episodes()
    for each in trajectories:
        each["actions"] = None
    pool = demonstrations.read(write(trajectories, tmp_path / "pool"), env=SPEC)
    assert pool.metadata["absent"] == ["action"]
    assert pool.transition.action.shape == (8, 1)
    assert np.isnan(pool.transition.action).all()
    demonstrations.save(tmp_path / "own.npz", pool)
    again = demonstrations.load(tmp_path / "own.npz", SPEC)
    np.testing.assert_array_equal(again.transition.action, pool.transition.action)


@pytest.mark.parametrize("name", WRITERS)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=8)
@given(lengths=pools.episode_lengths, number=st.integers(0, 10**6))
def test_a_round_trip_keeps_the_steps(name, tmp_path, lengths, number):
    trajectories = episodes(lengths)
    folder = tmp_path / f"{number}-{len(os.listdir(tmp_path))}"
    folder.mkdir()
    pool = demonstrations.read(WRITERS[name](trajectories, folder / "pool"), env=SPEC)
    assert_steps(pool, trajectories)


FILES = [name for name in WRITERS if name not in ("d4rl", "trajectories", "minari")]


@pytest.mark.parametrize("name", [*FILES, *OTHER_FILES])
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=25)
@given(damage=damages.damages())
def test_a_damaged_file_is_refused_in_a_line_or_reads_as_a_valid_pool(name, tmp_path, damage):
    path = tmp_path / "pool"
    written = {**WRITERS, **OTHER_FILES}[name]
    if not any(tmp_path.iterdir()):
        written(episodes(), path)
    (source,) = tmp_path.iterdir()
    file = source / "data-00000-of-00001.arrow" if source.is_dir() else source
    with damages.done_to(file, damage):
        pool, message = _attempt(source, name.split()[0])
    if message is None:
        demonstrations.validate(pool, SPEC)
    else:
        assert "\n" not in message


def _attempt(source, name):
    try:
        return demonstrations.read(source, name, env=SPEC), None
    except (ValueError, OSError) as error:
        return None, str(error)


def test_what_nobody_knows_is_refused_with_what_there_is(tmp_path):
    other = tmp_path / "other.npz"
    np.savez(other, weights=np.ones(3))
    with pytest.raises(
        ValueError, match=r"other.npz: no demonstrations of a known .*it holds weights"
    ):
        demonstrations.read(other)
    with pytest.raises(ValueError, match=r"the int is no demonstrations of a known format"):
        demonstrations.read(3)
    with pytest.raises(ValueError, match="unknown format of demonstrations 'pickle'; there"):
        demonstrations.read(other, "pickle")
    with pytest.raises(ValueError, match="read as d4rl-file, it has no array 'observations'"):
        demonstrations.read(other, "d4rl-file")
    for source, name in ((other, "d4rl"), (str(other), "trajectories"), ({"obs": 1}, "minari")):
        with pytest.raises(ValueError, match=f": format {name} is .*; give another"):
            demonstrations.read(source, name)
    with pytest.raises(ValueError, match="it does not name its task: give env; give format if"):
        demonstrations.read(as_csv(episodes(), tmp_path / "pool"))
    with pytest.raises(FileNotFoundError, match="there is no file none"):
        demonstrations.read("none.csv")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe: not a regular file"):
        demonstrations.read(tmp_path / "pipe")


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    path = as_csv(episodes(), tmp_path / "pool")
    monkeypatch.setitem(__import__("sys").modules, "polars", None)
    with pytest.raises(ModuleNotFoundError, match=r"install cmedirl-jax\[cli\]"):
        demonstrations.read(path, env=SPEC)
