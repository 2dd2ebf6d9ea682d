"""Formats of demonstrations x what theirs may lack: each reads what each can say."""

import json
import os

import gymnasium
import numpy as np
import polars as pl
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.formats import tables
from tests.support import damages, pools

ENV, SPEC = pools.ENV, pools.ENV.spec
PUSHES = 0.3


@pytest.fixture(scope="module", autouse=True)
def minaris_folder(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MINARI_DATASETS_PATH", str(tmp_path_factory.mktemp("minari")))
        yield


def episodes(lengths=(3, 1, 4)):
    """Trajectories of the task's own steps from rest, float64."""
    found = []
    car = gymnasium.make(SPEC.id)
    for index, length in enumerate(lengths):
        seen, done, paid = [car.reset(seed=index)[0]], [], []
        for _ in range(length):
            done.append([PUSHES + 0.1 * index])
            observation, reward, *_ = car.step(np.float32(done[-1]))
            seen.append(observation)
            paid.append(float(reward))
        found.append(
            {
                "observations": np.array(seen, np.float64),
                "actions": np.array(done, np.float64),
                "rewards": np.array(paid, np.float64),
                "terminated": False,
            }
        )
    return found


# One writer for each format, as the libraries that own them write theirs.


def as_imitation(trajectories, path):
    arrays = {
        "obs": np.concatenate([each["observations"] for each in trajectories]),
        "acts": np.concatenate([each["actions"] for each in trajectories]),
        "infos": np.array([{"pickled": True}] * sum(len(t["actions"]) for t in trajectories)),
        "terminal": np.array([each["terminated"] for each in trajectories]),
        "indices": np.cumsum([len(each["actions"]) for each in trajectories]),
    }
    if trajectories[0]["rewards"] is not None:
        arrays["rews"] = np.concatenate([each["rewards"] for each in trajectories])
    np.savez_compressed(path.with_suffix(".npz"), **arrays)
    return path.with_suffix(".npz")


def as_imitation_folder(trajectories, path):
    path.mkdir()
    columns = {
        "obs": [each["observations"].tolist() for each in trajectories],
        "acts": [each["actions"].tolist() for each in trajectories],
        "infos": [["{}"] * len(each["actions"]) for each in trajectories],
        "terminal": [each["terminated"] for each in trajectories],
    }
    if trajectories[0]["rewards"] is not None:
        columns["rews"] = [each["rewards"].tolist() for each in trajectories]
    pl.DataFrame(columns).write_ipc_stream(path / "data-00000-of-00001.arrow")
    (path / "dataset_info.json").write_text("{}")
    (path / "state.json").write_text("{}")
    return path


def as_stable_baselines(trajectories, path):
    lengths = [len(each["actions"]) for each in trajectories]
    arrays = {
        "obs": np.concatenate([each["observations"][:-1] for each in trajectories]),
        "actions": np.concatenate([each["actions"] for each in trajectories]),
        "episode_returns": np.zeros(len(trajectories)),
        "episode_starts": np.concatenate([np.arange(length) == 0 for length in lengths]),
    }
    if trajectories[0]["rewards"] is not None:
        arrays["rewards"] = np.concatenate([each["rewards"] for each in trajectories])
    np.savez(path.with_suffix(".npz"), **arrays)
    return path.with_suffix(".npz")


def as_d4rl(trajectories, path):
    del path
    ends = [np.arange(len(each["actions"])) == len(each["actions"]) - 1 for each in trajectories]
    lengths = [len(each["actions"]) for each in trajectories]
    over = np.repeat([each["terminated"] for each in trajectories], lengths) & np.concatenate(ends)
    unfinished = np.arange(len(over)) == len(over) - 1
    unfinished &= not trajectories[-1].get("truncated", True)
    arrays = {
        "observations": np.concatenate([each["observations"][:-1] for each in trajectories]),
        "actions": np.concatenate([each["actions"] for each in trajectories]),
        "next_observations": np.concatenate([each["observations"][1:] for each in trajectories]),
        "terminals": over,
        "timeouts": np.concatenate(ends) & ~over & ~unfinished,
    }
    if trajectories[0]["rewards"] is not None:
        arrays["rewards"] = np.concatenate([each["rewards"] for each in trajectories])
    return arrays


def as_d4rl_npz(trajectories, path):
    np.savez(path.with_suffix(".npz"), **as_d4rl(trajectories, path))
    return path.with_suffix(".npz")


def as_d4rl_hdf5(trajectories, path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(path.with_suffix(".hdf5"), "w") as file:
        for name, array in as_d4rl(trajectories, path).items():
            file[name] = array
    return path.with_suffix(".hdf5")


def as_table(trajectories, path, ending):
    rows = []
    for index, each in enumerate(trajectories):
        for step in range(len(each["observations"]) - 1):
            row = {"episode": index}
            row |= {f"observation_{i}": x for i, x in enumerate(each["observations"][step])}
            if each["actions"] is not None:
                row |= {f"action_{i}": x for i, x in enumerate(each["actions"][step])}
            if each["rewards"] is not None:
                row["reward"] = each["rewards"][step]
            last = step == len(each["observations"]) - 2
            row["terminated"] = last and each["terminated"]
            row["truncated"] = last and each.get("truncated", not each["terminated"])
            after = each["observations"][step + 1]
            row |= {f"next_observation_{i}": x for i, x in enumerate(after)}
            rows.append(row)
    table = pl.DataFrame(rows)
    path = path.with_suffix(ending)
    table.write_csv(path) if ending == ".csv" else table.write_parquet(path)
    return path


def as_csv(trajectories, path):
    return as_table(trajectories, path, ".csv")


def as_parquet(trajectories, path):
    return as_table(trajectories, path, ".parquet")


def as_npz(trajectories, path):
    demonstrations.save(path.with_suffix(".npz"), as_pool(trajectories))
    return path.with_suffix(".npz")


def as_minari(trajectories, path):
    pytest.importorskip("minari")
    name = f"test/{path.parent.name.replace('_', '-')}/{path.name}-v0"
    demonstrations.to_minari(as_pool(trajectories), name, spec=SPEC, **FACTS)
    return name


def as_pool(trajectories):
    return demonstrations.from_trajectories(trajectories, SPEC)


FACTS = {
    "eval_env": SPEC.id,
    "algorithm_name": "a rule",
    "author": "somebody",
    "author_email": "somebody@example.org",
    "code_permalink": "https://example.org",
    "description": "cars",
    "ref_min_score": -10.0,
    "ref_max_score": 90.0,
    "requirements": ["gymnasium"],
}
WRITERS = {
    "npz": as_npz,
    "imitation": as_imitation,
    "imitation-folder": as_imitation_folder,
    "stable-baselines": as_stable_baselines,
    "d4rl": as_d4rl,
    "d4rl-file": as_d4rl_npz,
    "table": as_csv,
    "minari": as_minari,
    "trajectories": lambda trajectories, path: trajectories,
}
OTHER_FILES = {"d4rl-file hdf5": as_d4rl_hdf5, "table parquet": as_parquet}
EACH = [*WRITERS.items(), *OTHER_FILES.items()]
NO_ENDS = ("stable-baselines",)
"""They say neither how an episode ended nor what was observed last."""
formats = pytest.mark.parametrize(("name", "write"), EACH, ids=[name for name, _ in EACH])


def assert_steps(pool, trajectories, rewards=True):
    """The pool's steps are the trajectories', but for what float32 rounds."""
    made = pool.transition
    expected = np.concatenate([each["observations"][:-1] for each in trajectories])
    np.testing.assert_allclose(made.observation, expected, rtol=1e-6, atol=1e-7)
    actions = np.concatenate([each["actions"] for each in trajectories])
    np.testing.assert_allclose(made.action, actions, rtol=1e-6)
    if rewards:
        paid = np.concatenate([each["rewards"] for each in trajectories])
        np.testing.assert_allclose(made.reward, paid, rtol=1e-5, atol=1e-7)
    lengths = [len(each["actions"]) for each in trajectories]
    assert demonstrations.episodes(pool).length.tolist() == lengths
    for column in (made.observation, made.action, made.reward, made.next_observation):
        assert column.dtype == np.float32


@formats
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


@formats
def test_terminations_are_told_from_truncations(name, write, tmp_path):
    if name in NO_ENDS:
        pytest.skip("it does not say")
    trajectories = episodes()
    trajectories[1]["terminated"] = True
    pool = demonstrations.read(write(trajectories, tmp_path / "pool"), env=SPEC)
    assert np.flatnonzero(pool.transition.terminated).tolist() == [3]
    assert np.flatnonzero(pool.truncated).tolist() == [2, 7]


@formats
def test_a_last_episode_may_be_unfinished(name, write, tmp_path):
    trajectories = episodes()
    trajectories[-1]["truncated"] = False
    pool = demonstrations.read(write(trajectories, tmp_path / "pool"), env=SPEC)
    told = name.split()[0] in ("trajectories", "table", "npz", "d4rl", "d4rl-file")
    assert np.flatnonzero(pool.truncated).tolist() == ([2, 3] if told else [2, 3, 7])


@formats
def test_what_is_missing_the_task_computes_or_the_pool_lacks(name, write, tmp_path):
    if name == "minari":
        pytest.skip("its datasets have rewards")
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


@formats
def test_whole_rewards_are_floats(name, write, tmp_path):
    trajectories = episodes()
    for each in trajectories:
        each["rewards"] = np.arange(len(each["rewards"]))
    pool = demonstrations.read(write(trajectories, tmp_path / "pool"), env=SPEC)
    assert pool.transition.reward.tolist() == [0, 1, 2, 0, 0, 1, 2, 3]
    assert pool.transition.reward.dtype == np.float32


@formats
def test_actions_out_of_bounds_are_refused_or_clipped(name, write, tmp_path):
    if name == "minari":
        pytest.skip("Minari's own writer refuses them")
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
    with pytest.raises(ValueError, match="it does not name its task: give env; give format if"):
        demonstrations.read(as_csv(episodes(), tmp_path / "pool"))
    with pytest.raises(FileNotFoundError, match="there is no file none"):
        demonstrations.read("none.csv")
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ValueError, match="pipe: not a regular file"):
        demonstrations.read(tmp_path / "pipe")


def test_no_pickle_is_ever_loaded(tmp_path):
    class Bomb:
        def __reduce__(self):
            return (print, ("it was loaded",))

    trajectories = episodes()
    path = as_imitation(trajectories, tmp_path / "pool")
    with np.load(path, allow_pickle=True) as file:
        arrays = dict(file)
    arrays["infos"] = np.array([Bomb()] * 8)
    np.savez(path, **arrays)
    assert_steps(demonstrations.read(path, env=SPEC), trajectories)
    arrays["rews"] = np.array([Bomb()] * 8, dtype=object)
    np.savez(path, **arrays)
    with pytest.raises(ValueError, match=r"read as imitation, it is damaged .*pickled objects"):
        demonstrations.read(path, env=SPEC)


def test_a_missing_package_is_named_with_its_extra(tmp_path, monkeypatch):
    path = as_csv(episodes(), tmp_path / "pool")
    monkeypatch.setitem(__import__("sys").modules, "polars", None)
    with pytest.raises(ModuleNotFoundError, match=r"install cmedirl-jax\[cli\]"):
        demonstrations.read(path, env=SPEC)


def test_a_template_has_every_column_and_is_read(tmp_path):
    for ending in (".csv", ".parquet"):
        path = tmp_path / f"template{ending}"
        tables.write_template(path, SPEC)
        pool = demonstrations.read(path, env=SPEC)
        assert pool.transition.terminated.tolist() == [False, True]
        tables.write_table(path, pool)
        assert demonstrations.read(path, env=SPEC).metadata == pool.metadata
    with pytest.raises(ValueError, match=r"ends in .csv or .parquet"):
        tables.write_template(tmp_path / "template.xlsx", SPEC)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda table: table.drop("episode"), "it has no column 'episode'"),
        (lambda table: table.drop("observation_0"), "columns observation_ are not numbered from 0"),
        (lambda table: table.rename({"reward": "pay"}), "unknown column 'pay'"),
        (lambda table: table.drop("next_observation_1"), "not as many columns next_observation_"),
        (lambda table: table.with_columns(episode=pl.col("episode") + 0.5), "not whole numbers"),
        (lambda table: table.with_columns(action_0=pl.lit("left")), "actions are .*not numbers"),
    ],
)
def test_tables_of_another_layout_are_refused_by_their_column(change, message, tmp_path):
    path = as_csv(episodes(), tmp_path / "pool")
    change(pl.read_csv(path)).write_csv(path)
    with pytest.raises(ValueError, match=message):
        demonstrations.read(path, env=SPEC)


def test_a_dataset_of_minaris_keeps_its_seeds_and_metadata(tmp_path):
    minari = pytest.importorskip("minari")
    pool = as_pool(episodes())
    pool = pool._replace(metadata=pool.metadata | {"seeds": [5, 6, 7]})
    demonstrations.to_minari(pool, "test/kept-v3", spec=SPEC, **FACTS)
    # Minari alone reads it.
    dataset = minari.load_dataset("test/kept-v3")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 8)
    assert dataset.env_spec.id == SPEC.id
    again = demonstrations.from_minari("test/kept-v3")
    assert again.metadata["seeds"] == [5, 6, 7]
    assert again.metadata["author"] in ("somebody", ["somebody"])
    assert again.metadata["ref_max_score"] == 90.0
    assert json.dumps(again.metadata)
    with pytest.raises(ValueError, match="already exist"):
        demonstrations.to_minari(pool, "test/kept-v3", spec=SPEC, **FACTS)
    with pytest.raises(ValueError, match="Minari's ids are"):
        demonstrations.to_minari(pool, "no version", spec=SPEC)
    with pytest.raises(FileNotFoundError, match=r"fetch it by: minari download test/absent-v0"):
        demonstrations.read("test/absent-v0")


def test_a_minari_dataset_of_an_environment_that_is_not_here(tmp_path):
    minari = pytest.importorskip("minari")
    from minari.data_collector.episode_buffer import EpisodeBuffer

    box = gymnasium.spaces.Box
    trajectory = episodes([3])[0]
    buffer = EpisodeBuffer(
        id=0,
        observations=trajectory["observations"],
        actions=trajectory["actions"],
        rewards=list(trajectory["rewards"]),
        terminations=[False, False, True],
        truncations=[False] * 3,
    )
    facts = {name: value for name, value in FACTS.items() if name != "eval_env"}
    with pytest.warns(UserWarning, match="env"):
        minari.create_dataset_from_buffers(
            "test/foreign-v0",
            [buffer],
            observation_space=box(-2, 2, (2,), np.float64),
            action_space=box(-1, 1, (1,), np.float64),
            **facts,
        )
    with pytest.raises(ValueError, match="it does not name its task: give env"):
        demonstrations.from_minari("test/foreign-v0")
    pool = demonstrations.read("test/foreign-v0", env=SPEC)
    assert pool.transition.terminated.tolist() == [False, False, True]
