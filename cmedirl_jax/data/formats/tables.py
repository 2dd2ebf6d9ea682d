"""Demonstrations as tables: CSV, Parquet, and imitation's Hugging Face folders, by polars.

A table of ours has a row for each step and these columns:

    episode                  whole numbers; an episode's rows are those of one, in their order
    observation_0, ...       what was observed before the step
    action_0, ...            what was done; left out for state-only demonstrations
    reward                   what was paid; may be left out
    terminated, truncated    whether the episode ended here, by the task or otherwise; may be
                             left out, and then every episode was truncated at its last row
    next_observation_0, ...  what was observed after the step; only an episode's last row is read;
                             may be left out
"""

import re
from pathlib import Path
from typing import Any

import numpy as np

from cmedirl_jax.data.formats.base import Format, is_file, named, naming_damage
from cmedirl_jax.data.trajectories import from_trajectories
from cmedirl_jax.data.validation import absent
from cmedirl_jax.io import atomic
from cmedirl_jax.types import Demonstrations, EnvSpec

_NUMBERED = re.compile(r"(observation|action|next_observation)_(\d+)")
_FLAGS = ("terminated", "truncated")
ENDINGS = (".csv", ".parquet")
"""Of the names of tables."""


def of_table(source: Any, env: str | EnvSpec | None) -> Demonstrations:
    """A CSV or Parquet file; raises as `base.Read`."""
    import polars as pl

    read = pl.read_csv if str(source).lower().endswith(".csv") else pl.read_parquet
    with naming_damage(OSError):
        table = read(Path(source).read_bytes())
    return _of_columns({name: table[name].to_numpy() for name in table.columns}, named(env))


def _of_columns(columns: dict[str, np.ndarray], env: str | EnvSpec) -> Demonstrations:
    """Columns `[N]` by their names."""
    if "episode" not in columns:
        raise ValueError("it has no column 'episode'")
    episode = columns["episode"]
    if episode.dtype.kind not in "iu":
        raise ValueError(f"episode holds {episode.dtype}, not whole numbers")
    widths = _widths(columns)
    if not widths["observation"]:
        raise ValueError("it has no column 'observation_0'")
    if widths["next_observation"] not in (0, widths["observation"]):
        raise ValueError("it has not as many columns next_observation_ as observation_")

    def block(name: str) -> np.ndarray | None:
        parts = [columns[f"{name}_{index}"] for index in range(widths[name])]
        return np.stack(parts, axis=1) if parts else None

    observation, action, successor = map(block, ("observation", "action", "next_observation"))
    assert observation is not None
    trajectories = []
    for rows in _rows_of(episode):
        trajectory: dict[str, Any] = {
            "observations": observation[rows],
            "actions": None if action is None else action[rows],
            "rewards": columns["reward"][rows] if "reward" in columns else None,
        }
        if successor is not None:
            trajectory["observations"] = np.concatenate([observation[rows], successor[rows[-1:]]])
        for flag in _FLAGS:
            if flag in columns:
                trajectory[flag] = bool(columns[flag][rows[-1]])
        trajectories.append(trajectory)
    return from_trajectories(trajectories, env)


def _widths(columns: dict[str, np.ndarray]) -> dict[str, int]:
    """How many numbered columns there are of each kind.

    Raises:
        ValueError: for an unknown column, or a number that is left out.
    """
    numbers: dict[str, list[int]] = {"observation": [], "action": [], "next_observation": []}
    for name in columns:
        if matched := _NUMBERED.fullmatch(name):
            numbers[matched[1]].append(int(matched[2]))
        elif name not in ("episode", "step", "reward", *_FLAGS):
            raise ValueError(f"unknown column {name!r}; see `cmedirl_jax.data.formats.tables`")
    for name, found in numbers.items():
        if sorted(found) != list(range(len(found))):
            raise ValueError(f"the columns {name}_ are not numbered from 0 without gaps")
    return {name: len(found) for name, found in numbers.items()}


def _rows_of(episode: np.ndarray) -> list[np.ndarray]:
    """The rows of each episode, in the order in which the episodes begin."""
    _, first, which = np.unique(episode, return_index=True, return_inverse=True)
    return [np.flatnonzero(which == index) for index in np.argsort(first)]


def write_table(path: str | Path, demonstrations: Demonstrations) -> None:
    """Write a pool as a CSV or Parquet file, by the name's ending; what is absent has no column.

    Raises:
        ValueError: for another ending, or as `validation.absent`.
        OSError: if it cannot be written.
        ModuleNotFoundError: without polars, of the extra `cli`.
    """
    made, columns = demonstrations.transition, {"episode": np.asarray(demonstrations.episode)}
    lacking = absent(demonstrations)
    for name in ("observation", "action", "next_observation"):
        if name not in lacking:
            values = np.asarray(getattr(made, name))
            columns |= {f"{name}_{index}": values[:, index] for index in range(values.shape[1])}
    if "reward" not in lacking:
        columns["reward"] = np.asarray(made.reward)
    columns["terminated"] = np.asarray(made.terminated)
    columns["truncated"] = np.asarray(demonstrations.truncated)
    _write(Path(path), columns)


def write_template(path: str | Path, spec: EnvSpec) -> None:
    """Write an episode of two steps of zeros, with every column that a task's table may have.

    Raises:
        ValueError: for an ending that is neither .csv nor .parquet.
        OSError: if it cannot be written.
        ModuleNotFoundError: without polars, of the extra `cli`.
    """

    def numbered(name: str, count: int) -> dict[str, list[float]]:
        return {f"{name}_{index}": [0.0, 0.0] for index in range(count)}

    columns = {
        "episode": [0, 0],
        **numbered("observation", spec.observation_dim),
        **numbered("action", spec.action_dim),
        "reward": [0.0, 0.0],
        "terminated": [False, True],
        "truncated": [False, False],
        **numbered("next_observation", spec.observation_dim),
    }
    _write(Path(path), columns)


def _write(path: Path, columns: dict[str, Any]) -> None:
    import polars as pl

    if path.suffix.lower() not in ENDINGS:
        raise ValueError(f"{path}: give a name that ends in .csv or .parquet")
    table = pl.DataFrame(columns)
    with atomic.replacing(path) as partial:
        if path.suffix.lower() == ".csv":
            table.write_csv(partial)
        else:
            table.write_parquet(partial)


def of_imitation_folder(source: Any, env: str | EnvSpec | None) -> Demonstrations:
    """A folder that imitation saved: Arrow streams with a row for each trajectory.

    Raises as `base.Read`.
    """
    import polars as pl

    files = sorted(Path(source).glob("*.arrow"))
    if not files:
        raise ValueError("it holds no .arrow file")
    with naming_damage(OSError):
        table = pl.concat([pl.read_ipc_stream(file.read_bytes()) for file in files])
    missing = [name for name in ("obs", "acts", "terminal") if name not in table.columns]
    if missing:
        raise ValueError(f"it has no column {missing[0]!r}")
    return from_trajectories(
        [
            {
                "observations": row["obs"],
                "actions": row["acts"],
                "rewards": row.get("rews"),
                "terminated": row["terminal"],
            }
            for row in table.select(pl.exclude("infos")).iter_rows(named=True)
        ],
        named(env),
    )


TABLE = Format(
    "a CSV or Parquet file with a row for each step",
    lambda source: is_file(source, *ENDINGS),
    of_table,
    lambda target: Path(target).suffix.lower() in ENDINGS,
    lambda target, demonstrations, spec: write_table(target, demonstrations),
    package="cli",
)
IMITATION_FOLDER = Format(
    "imitation's folder of a Hugging Face dataset",
    lambda source: (
        isinstance(source, str | Path) and (Path(source) / "dataset_info.json").is_file()
    ),
    of_imitation_folder,
    package="cli",
)
