"""Trajectories in memory, and archives of arrays: imitation's, stable-baselines', d4rl's.

imitation's npz holds `obs`, `acts`, `rews`, `terminal` and `indices`, the ends of the trajectories;
its infos are pickled and are not read. stable-baselines' holds `obs`, `actions`, `rewards` and
`episode_starts`. d4rl's dictionaries, npz or HDF5, hold `observations`, `actions`, `rewards`,
`terminals`, and maybe `timeouts` and `next_observations`.
"""

import zipfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cmedirl_jax.data.formats.base import Format, is_file, named, naming_damage
from cmedirl_jax.data.trajectories import from_trajectories
from cmedirl_jax.io import npz
from cmedirl_jax.types import Demonstrations, EnvSpec


def names_in(source: Any) -> frozenset[str]:
    """The names of the arrays in an npz file; none for anything else."""
    if not is_file(source, ".npz"):
        return frozenset()
    try:
        with zipfile.ZipFile(source) as archive:
            return frozenset(name.removesuffix(".npy") for name in archive.namelist())
    except (OSError, ValueError, zipfile.BadZipFile):
        return frozenset()


def read_npz(path: str | Path, wanted: Sequence[str], optional: Sequence[str] = ()) -> Any:
    """Arrays of an npz file by their names, without pickle.

    Raises:
        ValueError: if one that is wanted is missing, or the file is damaged.
        OSError: if it cannot be read.
    """
    present = names_in(path)
    missing = [name for name in wanted if name not in present]
    if missing:
        raise ValueError(f"it has no array {missing[0]!r}")
    with naming_damage(OSError):
        return npz.read(Path(path), [*wanted, *(name for name in optional if name in present)])


def cut(length: int, ends: np.ndarray) -> list[slice]:
    """The rows of each episode, from the rows behind their last ones, which grow up to `length`.

    Raises:
        ValueError: if they do not.
    """
    ends = np.asarray(ends)
    if ends.ndim != 1 or ends.dtype.kind not in "iu":
        raise ValueError(f"the ends of episodes are {ends.dtype} of shape {ends.shape}")
    ends = ends.astype(np.int64)
    if not ends.size or (np.diff(ends, prepend=0) <= 0).any() or ends[-1] != length:
        raise ValueError(f"the ends of episodes do not grow from 1 to the {length} rows there are")
    return [slice(start, stop) for start, stop in zip(np.r_[0, ends[:-1]], ends, strict=True)]


def of_trajectories(source: Any, env: str | EnvSpec | None) -> Demonstrations:
    """A list of dictionaries, see `from_trajectories`; raises as `base.Read`."""
    return from_trajectories(source, named(env))


def of_imitation(source: Any, env: str | EnvSpec | None) -> Demonstrations:
    """imitation's npz; raises as `base.Read`."""
    found = read_npz(source, ("obs", "acts", "terminal", "indices"), ("rews",))
    steps = cut(len(found["acts"]), found["indices"])
    if found["terminal"].shape != (len(steps),):
        raise ValueError(f"terminal has shape {found['terminal'].shape} for {len(steps)} episodes")
    if len(found["obs"]) != len(found["acts"]) + len(steps):
        raise ValueError("an episode has one observation more than actions, here they do not")
    return from_trajectories(
        [
            {
                # Each trajectory before it has one observation more than steps.
                "observations": found["obs"][rows.start + index : rows.stop + index + 1],
                "actions": found["acts"][rows],
                "rewards": found["rews"][rows] if "rews" in found else None,
                "terminated": bool(found["terminal"][index]),
            }
            for index, rows in enumerate(steps)
        ],
        named(env),
    )


def of_stable_baselines(source: Any, env: str | EnvSpec | None) -> Demonstrations:
    """stable-baselines' npz, which says neither how an episode ended nor what was observed last.

    Raises as `base.Read`.
    """
    found = read_npz(source, ("obs", "actions", "episode_starts"), ("rewards",))
    starts = np.flatnonzero(np.asarray(found["episode_starts"], bool))
    rows = cut(len(found["obs"]), np.r_[starts[1:], len(found["obs"])])
    if not len(found["obs"]) == len(found["actions"]) == len(found["episode_starts"]):
        raise ValueError("obs, actions and episode_starts differ in length")
    if starts[0] != 0:
        raise ValueError("episode_starts does not begin with an episode")
    return from_trajectories(
        [
            {
                "observations": found["obs"][each],
                "actions": found["actions"][each],
                "rewards": found["rewards"].reshape(-1)[each] if "rewards" in found else None,
            }
            for each in rows
        ],
        named(env),
    )


_D4RL = ("observations", "actions", "terminals")
_D4RL_OPTIONAL = ("rewards", "timeouts", "next_observations")


def of_d4rl(source: Any, env: str | EnvSpec | None) -> Demonstrations:
    """A dictionary of d4rl's arrays; where there are no timeouts, only terminals end an episode.

    Raises as `base.Read`.
    """
    missing = [name for name in _D4RL if name not in source]
    if missing:
        raise ValueError(f"it has no array {missing[0]!r}")
    found = {name: np.asarray(source[name]) for name in (*_D4RL, *_D4RL_OPTIONAL) if name in source}
    size = len(found["observations"])
    for name, array in found.items():
        if len(array) != size:
            raise ValueError(f"{name} has {len(array)} rows, observations has {size}")
    terminals = found["terminals"].reshape(-1).astype(bool)
    timeouts = found.get("timeouts", np.zeros(size, bool)).reshape(-1).astype(bool)
    ends = np.flatnonzero(terminals | timeouts) + 1
    trajectories = []
    for rows in cut(size, ends if ends.size and ends[-1] == size else np.r_[ends, size]):
        last = rows.stop - 1
        observations = found["observations"][rows]
        if "next_observations" in found:
            observations = np.concatenate([observations, found["next_observations"][last:][:1]])
        trajectories.append(
            {
                "observations": observations,
                "actions": found["actions"][rows],
                "rewards": found["rewards"].reshape(-1)[rows] if "rewards" in found else None,
                "terminated": bool(terminals[last]),
                "truncated": bool(timeouts[last]),
            }
        )
    return from_trajectories(trajectories, named(env))


def of_d4rl_file(source: Any, env: str | EnvSpec | None) -> Demonstrations:
    """The same of an npz file, or an HDF5 file; raises as `base.Read`."""
    if is_file(source, ".npz"):
        return of_d4rl(read_npz(source, _D4RL, _D4RL_OPTIONAL), env)
    import h5py  # type: ignore[import-not-found]

    with naming_damage(PermissionError), h5py.File(source) as file:
        there: list[Any] = [(name, file.get(name)) for name in (*_D4RL, *_D4RL_OPTIONAL)]
        found = {name: array[()] for name, array in there if array is not None}
    return of_d4rl(found, env)


def _holds(*names: str) -> Callable[[Any], bool]:
    return lambda source: frozenset(names) <= names_in(source)


TRAJECTORIES = Format(
    "a list of dictionaries with observations, actions, rewards, terminated",
    lambda source: isinstance(source, Sequence) and not isinstance(source, str),
    of_trajectories,
    in_memory=True,
)
IMITATION = Format("imitation's npz", _holds("obs", "acts", "indices"), of_imitation)
STABLE_BASELINES = Format(
    "stable-baselines' npz", _holds("obs", "actions", "episode_starts"), of_stable_baselines
)
D4RL = Format(
    "a dictionary of d4rl's arrays",
    lambda source: isinstance(source, Mapping),
    of_d4rl,
    in_memory=True,
)
D4RL_FILE = Format(
    "an npz or HDF5 file of d4rl's arrays",
    lambda source: is_file(source, ".hdf5", ".h5") or _holds(*_D4RL)(source),
    of_d4rl_file,
    package="minari",
)
