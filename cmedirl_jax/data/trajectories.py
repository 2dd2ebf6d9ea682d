"""From trajectories, whatever they lack, to a pool of demonstrations.

    pool = demonstrations.from_trajectories(
        [dict(observations=seen, actions=actions, rewards=rewards, terminated=True), ...],
        env="Pendulum-v1",
    )

A pool's metadata say what it lacks: `absent` names the fields whose values are NaN,
`repeated_successors` counts the episodes whose last successor nobody observed: the last observation
stands there twice.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cmedirl_jax.data.validation import ABSENT, REPEATED
from cmedirl_jax.types import Demonstrations, EnvSpec, Transition

FIELDS = ("observations", "actions", "rewards", "terminated", "truncated")
"""What a trajectory may hold."""


def from_trajectories(
    trajectories: Sequence[Mapping[str, Any]],
    env: str | EnvSpec,
    *,
    metadata: Mapping[str, Any] | None = None,
) -> Demonstrations:
    """Make a pool of trajectories of numbers of any type.

    Args:
        trajectories: each with `observations` `[T + 1, O]`, or `[T, O]` where the last successor
            was not observed; `actions` `[T, A]`, or None in all of them for state-only
            demonstrations; `rewards` `[T]`, or None in all of them; `terminated`, whether the task
            ended it (default False); `truncated`, whether something else did (default: whenever the
            task did not; only the last trajectory may be neither, and so unfinished).
        env: their task's name, or its specification, which state-only demonstrations need.
        metadata: JSON values by name, to keep beside them.

    Returns:
        The pool, float32. It is not yet held to a task: see `validate`, `check` and `read`.

    Raises:
        ValueError: if there is none, sizes differ between trajectories, or there are no actions and
            `env` is a name. Naming a trajectory by its place: if a field is missing, unknown or not
            of numbers, its lengths do not fit each other, it does not end and is not the last one,
            or it has actions or rewards and another has none.
    """
    if not trajectories:
        raise ValueError("there are no trajectories")
    parts, repeated = [], 0
    for index, trajectory in enumerate(trajectories):
        try:
            part, repeats = _part(trajectory, index == len(trajectories) - 1)
        except (TypeError, ValueError) as error:
            raise ValueError(f"trajectory {index}: {error}") from error
        parts.append(part)
        repeated += repeats
    # What one lacks all lack.
    absent = []
    for name in ABSENT:
        lacking = [part[name] is None for part in parts]
        if any(lacking) and not all(lacking):
            have, lack = lacking.index(False), lacking.index(True)
            raise ValueError(f"trajectory {have} has {name}s, trajectory {lack} has none")
        absent += [name] * lacking[0]
    if "action" in absent and isinstance(env, str):
        raise ValueError("without actions: give the task's specification in place of its name")
    noted = {**(metadata or {}), "env": env if isinstance(env, str) else env.id}
    if absent:
        noted["absent"] = absent
    if repeated:
        noted[REPEATED] = repeated
    return _joined(parts, noted, 0 if isinstance(env, str) else env.action_dim)


def _part(trajectory: Mapping[str, Any], last: bool) -> tuple[dict[str, Any], bool]:
    """A trajectory's columns, and whether it repeats its last observation."""
    unknown = sorted(set(trajectory) - set(FIELDS))
    if unknown:
        raise ValueError(f"unknown field {unknown[0]!r}; there are {', '.join(FIELDS)}")
    if trajectory.get("observations") is None:
        raise ValueError("it has no observations")
    observations = _array("observations", trajectory["observations"], 2)
    actions, rewards = trajectory.get("actions"), trajectory.get("rewards")
    actions = None if actions is None else _array("actions", actions, 2)
    rewards = None if rewards is None else _array("rewards", rewards, 1)

    # How many steps, and whether the last successor is there.
    lengths = [len(each) for each in (actions, rewards) if each is not None]
    steps = lengths[0] if lengths else len(observations) - 1
    if steps < 1 or any(length != steps for length in lengths):
        raise ValueError(f"{len(observations)} observations, and {lengths} actions and rewards")
    if len(observations) not in (steps, steps + 1):
        raise ValueError(f"{len(observations)} observations for {steps} steps: give {steps + 1}")
    repeats = len(observations) == steps
    if repeats:
        observations = np.concatenate([observations, observations[-1:]])

    # How it ends.
    terminated = bool(trajectory.get("terminated", False))
    truncated = bool(trajectory.get("truncated", not terminated)) and not terminated
    if not (terminated or truncated or last):
        raise ValueError("it neither terminated nor was truncated, and is not the last one")
    at_end = np.arange(steps) == steps - 1
    columns = {
        "observation": observations[:-1],
        "action": actions,
        "reward": rewards,
        "next_observation": observations[1:],
        "terminated": at_end & terminated,
        "truncated": at_end & truncated,
    }
    return columns, repeats


def _array(name: str, values: Any, axes: int) -> np.ndarray:
    array = np.asarray(values)
    if array.dtype.kind not in "fiub":
        raise ValueError(f"{name} are {array.dtype}, not numbers")
    if array.ndim != axes:
        raise ValueError(f"{name} have shape {array.shape}, not {axes} axes")
    # Beyond float32 they become infinite, which no pool may hold.
    with np.errstate(over="ignore"):
        return array.astype(np.float32)


def _joined(
    parts: Sequence[Mapping[str, Any]], metadata: dict[str, Any], action_dim: int
) -> Demonstrations:
    lengths = [len(part["observation"]) for part in parts]
    size = sum(lengths)

    def column(name: str) -> np.ndarray:
        if parts[0][name] is None:
            shape = (size, action_dim) if name == "action" else (size,)
            return np.full(shape, np.nan, np.float32)
        try:
            return np.concatenate([part[name] for part in parts])
        except ValueError as error:
            shapes = sorted({part[name].shape[1:] for part in parts})
            raise ValueError(f"trajectories whose {name}s have shapes {shapes}") from error

    return Demonstrations(
        Transition(*(column(name) for name in Transition._fields)),
        column("truncated"),
        np.repeat(np.arange(len(parts), dtype=np.int32), lengths),
        metadata,
    )
