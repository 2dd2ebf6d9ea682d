"""Minari's datasets, both ways; their spaces must be boxes of one axis."""

import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np

from cmedirl_jax.data.formats.base import Format, named, naming_damage
from cmedirl_jax.data.trajectories import from_trajectories
from cmedirl_jax.data.validation import absent
from cmedirl_jax.envs import split_id
from cmedirl_jax.types import Demonstrations, EnvSpec

ID = re.compile(r"([\w-]+/)*[\w-]+-v\d+")
"""What Minari calls a dataset."""
FACTS = (
    *("algorithm_name", "author", "author_email", "code_permalink", "description"),
    *("ref_min_score", "ref_max_score", "requirements"),
)
"""Metadata of a dataset that a pool keeps, and gives to another one."""


def recognises(source: Any) -> bool:
    """Whether a source is an id of Minari's, or the folder of a dataset."""
    if not isinstance(source, str | Path):
        return False
    if (Path(source) / "data" / "metadata.json").is_file():
        return True
    return isinstance(source, str) and not os.path.exists(source) and bool(ID.fullmatch(source))


def from_minari(source: str | Path, env: str | EnvSpec | None = None) -> Demonstrations:
    """Read a dataset of Minari's; nothing is downloaded, and its environment is not made.

    Args:
        source: its id, or its folder.
        env: the task, its name or specification; default the name that the dataset gives it.

    Raises:
        ValueError: if it is damaged, for spaces that are no boxes of one axis, an episode that goes
            on after its end, or if nothing names the environment.
        FileNotFoundError: if there is no such dataset here.
        PermissionError: if it may not be read.
        ModuleNotFoundError: without the extra `minari`.
    """
    import minari  # type: ignore[import-not-found]

    folder = Path(source) / "data"
    try:
        with naming_damage(FileNotFoundError, PermissionError):
            dataset = (
                minari.MinariDataset(folder)
                if folder.is_dir()
                else minari.load_dataset(str(source), download=False)
            )
            episodes = list(dataset.iterate_episodes())
    except FileNotFoundError as error:
        raise FileNotFoundError(
            f"Minari has no dataset {source} here; fetch it by: minari download {source}"
        ) from error
    known = dataset.storage.metadata
    kept: dict[str, Any] = {name: known[name] for name in ("dataset_id", *FACTS) if name in known}
    kept = {name: list(x) if isinstance(x, set | tuple) else x for name, x in kept.items()}
    seeds = [_seed(dataset, episode) for episode in episodes]
    if any(seed is not None for seed in seeds):
        kept["seeds"] = seeds
    if env is None and dataset.env_spec is not None:
        env = dataset.env_spec.id
    return from_trajectories(
        [_trajectory(index, episode) for index, episode in enumerate(episodes)],
        named(env),
        metadata=kept,
    )


def _seed(dataset: Any, episode: Any) -> int | None:
    (metadata,) = dataset.storage.get_episode_metadata([episode.id])
    seed = metadata.get("seed")
    return None if seed is None else int(seed)


def _trajectory(index: int, episode: Any) -> dict[str, Any]:
    for name in ("observations", "actions"):
        if isinstance(getattr(episode, name), Mapping | tuple):
            raise ValueError(f"episode {index}: its {name} are no box of one axis")
    terminations, truncations = (
        np.asarray(flags, bool) for flags in (episode.terminations, episode.truncations)
    )
    ended = np.flatnonzero(terminations | truncations)
    if ended.size and ended[0] != len(terminations) - 1:
        raise ValueError(f"episode {index}: it goes on after its end at step {ended[0]}")
    return {
        "observations": episode.observations,
        "actions": episode.actions,
        "rewards": episode.rewards,
        "terminated": bool(terminations[-1]),
    }


def to_minari(
    demonstrations: Demonstrations, dataset_id: str, *, spec: EnvSpec | None = None, **facts: Any
) -> Any:
    """Make a dataset of Minari's, in Minari's folder of datasets.

    Args:
        demonstrations: the pool; it must have actions and rewards.
        dataset_id: its id, `(namespace/)(name/)name-vN`.
        spec: the task's, whose bounds become the spaces'; default what the pool spans.
        **facts: further arguments of `minari.create_dataset_from_buffers`: author, ref_min_score
            and so on; default those of the pool's metadata.

    Raises:
        ValueError: for another form of id, one that is taken, or a pool without actions or rewards.
        TypeError: for a fact that Minari does not know.
        ModuleNotFoundError: without the extra `minari`.
    """
    import minari  # type: ignore[import-not-found]
    from minari.data_collector.episode_buffer import EpisodeBuffer  # type: ignore[import-not-found]
    from minari.storage import get_dataset_path  # type: ignore[import-not-found]

    if not ID.fullmatch(str(dataset_id)):
        raise ValueError(f"{dataset_id}: Minari's ids are (namespace/)(name/)name-vN")
    for name in absent(demonstrations):
        raise ValueError(f"Minari's datasets have {name}s, this pool has none")
    metadata, seeds = demonstrations.metadata, demonstrations.metadata.get("seeds", [])
    known = {name: metadata[name] for name in FACTS if name in metadata}
    # Minari takes one author as text, and more as a set.
    known = {
        name: set(x) if name.startswith("author") and isinstance(x, list) else x
        for name, x in known.items()
    }
    facts = known | facts
    env = facts.pop("env", None) or _gymnasiums(metadata["env"])
    buffers = [
        EpisodeBuffer(**_buffer(own), id=index, seed=seeds[index] if index < len(seeds) else None)
        for index, own in enumerate(_episodes(demonstrations))
    ]
    box_of = {
        name: _space(np.asarray(getattr(demonstrations.transition, name)), spec, name)
        for name in ("observation", "action")
    }
    folder = get_dataset_path(dataset_id)
    was_there = folder.exists()
    try:
        return minari.create_dataset_from_buffers(
            dataset_id,
            buffers,
            env=env,
            observation_space=box_of["observation"],
            action_space=box_of["action"],
            **{"eval_env": env, **facts},
        )
    except Exception:
        # Minari leaves what it had begun, which would block the name.
        if not was_there:
            shutil.rmtree(folder, ignore_errors=True)
        raise


def _buffer(own: dict[str, np.ndarray]) -> dict[str, Any]:
    """An episode as Minari's buffer takes it."""
    return {
        "observations": np.concatenate([own["observation"], own["next_observation"][-1:]]),
        "actions": own["action"],
        "rewards": own["reward"],
        "terminations": own["terminated"],
        "truncations": own["truncated"],
        "infos": {},
    }


def _episodes(demonstrations: Demonstrations) -> list[dict[str, np.ndarray]]:
    columns = {**demonstrations.transition._asdict(), "truncated": demonstrations.truncated}
    episode = np.asarray(demonstrations.episode)
    ends = np.flatnonzero(np.diff(episode)) + 1
    parts = {name: np.split(np.asarray(column), ends) for name, column in columns.items()}
    return [{name: part[index] for name, part in parts.items()} for index in range(len(ends) + 1)]


def _space(values: np.ndarray, spec: EnvSpec | None, name: str) -> gymnasium.spaces.Box:
    if spec is not None:
        low, high = getattr(spec, f"{name}_low"), getattr(spec, f"{name}_high")
    else:
        low, high = values.min(axis=0), values.max(axis=0)
    return gymnasium.spaces.Box(low, high, dtype=np.float32)


def _gymnasiums(env: str) -> str | None:
    """The environment's name where Gymnasium knows it: Minari can then make it again."""
    name = split_id(env)[1]
    return name if name in gymnasium.registry else None


MINARI = Format(
    "a dataset of Minari's, by its id or folder",
    recognises,
    from_minari,
    lambda target: bool(ID.fullmatch(target)),
    lambda target, demonstrations, spec: to_minari(demonstrations, target, spec=spec),
    package="minari",
)
