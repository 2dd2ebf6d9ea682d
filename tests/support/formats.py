"""Trajectories of the car, written as the libraries that own a format write theirs."""

import gymnasium
import numpy as np
import polars as pl
import pytest

from cmedirl_jax.data import demonstrations
from tests.support import pools

SPEC = pools.ENV.spec
PUSHES = 0.3


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
