"""Whether a pool of demonstrations is what it claims to be, on the host, where it enters."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, rounding
from cmedirl_jax.envs import Env, HostEnv, split_id
from cmedirl_jax.envs.base import step_from
from cmedirl_jax.types import Demonstrations, EnvSpec, Transition

ABSENT = ("action", "reward")
"""The fields that a pool may lack. Its metadata then name them under "absent", and all of their
values are NaN."""
REPEATED = "repeated_successors"
"""In a pool's metadata: how many episodes repeat their last observation as its successor, which
nobody observed."""
_KINDS = {
    "terminated": ("b", "bool"),
    "truncated": ("b", "bool"),
    "episode": ("i", "signed integers"),
}


def validate(demonstrations: Demonstrations, spec: EnvSpec | None = None) -> None:
    """Check a pool, against a task's specification if `spec` is given.

    Raises:
        ValueError: naming the first mistake: wrong shapes or dtypes, no steps, values in fields
            that the metadata call absent, values that are not finite in others, episodes out of
            order. With `spec` also: another environment, observations or actions out of bounds, a
            `next_observation` that is not the following step's observation in the same episode, or
            a specification that contradicts itself.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    transition, truncated, episode, metadata = demonstrations
    if spec is not None:
        checks.env_spec(spec)
    if spec is not None and _bare(metadata.get("env")) != _bare(spec.id):
        raise ValueError(f"made for environment {metadata.get('env')!r}, not {spec.id!r}")
    arrays = {**transition._asdict(), "truncated": truncated, "episode": episode}
    arrays = {name: np.asarray(array) for name, array in arrays.items()}
    lacking = absent(demonstrations)
    _validate_arrays(arrays, lacking)
    _validate_episodes(arrays)
    if spec is not None:
        _validate_sizes(arrays, spec)
        _validate_bounds({name: x for name, x in arrays.items() if name not in lacking}, spec)
        _validate_continuity(arrays)


def _bare(env: Any) -> Any:
    return split_id(env)[1] if isinstance(env, str) else env


def absent(demonstrations: Demonstrations) -> tuple[str, ...]:
    """The fields that a pool lacks, of `ABSENT`.

    Raises:
        ValueError: if its metadata name others.
    """
    metadata = demonstrations.metadata
    named = metadata.get("absent", []) if isinstance(metadata, dict) else []
    if not isinstance(named, list) or any(name not in ABSENT for name in named):
        raise ValueError(f"absent in its metadata is {named!r}, no list of {' and '.join(ABSENT)}")
    return tuple(named)


def _validate_arrays(arrays: dict[str, np.ndarray], lacking: tuple[str, ...]) -> None:
    size = arrays["reward"].shape
    if len(size) != 1 or size[0] == 0:
        raise ValueError(f"reward must be [N] with N > 0, got shape {size}")
    for name, array in arrays.items():
        vector = name in ("observation", "next_observation", "action")
        if array.shape[:1] != size or array.ndim != (2 if vector else 1):
            raise ValueError(f"{name} has shape {array.shape}, reward has {size}")
        kind, words = _KINDS.get(name, ("f", "floats"))
        if array.dtype.kind != kind:
            raise ValueError(f"{name} has dtype {array.dtype}, expected {words}")
        if name in lacking:
            if not np.isnan(array).all():
                raise ValueError(f"{name} is absent by the metadata, and holds values")
        elif not (np.abs(array) <= np.finfo(np.float32).max).all():
            raise ValueError(f"{name} holds values that are not finite")
    if arrays["observation"].shape != arrays["next_observation"].shape:
        raise ValueError("observation and next_observation differ in shape")


def _validate_episodes(arrays: dict[str, np.ndarray]) -> None:
    change = np.diff(arrays["episode"].astype(np.int64))
    if arrays["episode"][0] != 0 or not np.isin(change, (0, 1)).all():
        raise ValueError("episode must count 0, 0, ..., 1, 1, ... without gaps")
    ended = arrays["terminated"] | arrays["truncated"]
    if not np.array_equal(ended[:-1], change == 1):
        raise ValueError("each episode but the last must end, and only there, at its last step")


def _validate_sizes(arrays: dict[str, np.ndarray], spec: EnvSpec) -> None:
    for name, dim in (("observation", spec.observation_dim), ("action", spec.action_dim)):
        if arrays[name].shape[1] != dim:
            raise ValueError(f"{name} has {arrays[name].shape[1]} dimensions, {spec.id} has {dim}")


def _validate_bounds(arrays: dict[str, np.ndarray], spec: EnvSpec) -> None:
    for name in ("action", "observation", "next_observation"):
        if name not in arrays:
            continue
        of = name.removeprefix("next_")
        low, high = getattr(spec, f"{of}_low"), getattr(spec, f"{of}_high")
        outside = rounding.outside(arrays[name], low, high)
        if outside.any():
            row, column = np.argwhere(outside)[0]
            raise ValueError(
                f"{_place(arrays['episode'], row)}: {name}[{column}] is "
                f"{arrays[name][row, column]:.7g}, {spec.id} keeps it in "
                f"{low[column]:.7g} to {high[column]:.7g}"
            )


def _validate_continuity(arrays: dict[str, np.ndarray]) -> None:
    before = np.flatnonzero(np.diff(arrays["episode"]) == 0)
    tolerance = rounding.tolerance(arrays["next_observation"])[before]
    found = arrays["next_observation"][before].astype(np.float64)
    following = arrays["observation"][before + 1]
    wrong = np.argwhere(np.abs(found - following) > tolerance)
    if wrong.size:
        row, column = wrong[0]
        raise ValueError(
            f"{_place(arrays['episode'], int(before[row]))}: next_observation[{column}] is "
            f"{found[row, column]:.7g}, the following step's observation is "
            f"{following[row, column]:.7g} (tolerance {tolerance[row, column]:.1e})"
        )


def can_be_repeated(demonstrations: Demonstrations, env: Env | HostEnv) -> bool:
    """Whether `check` compares each step with the task's own, and not just bounds and order.

    Raises:
        ValueError: as `absent`.
    """
    settable = isinstance(env, Env) and env.state_at is not None
    return settable and "action" not in absent(demonstrations)


def check(demonstrations: Demonstrations, env: Env | HostEnv, params: Any = None) -> None:
    """Check a pool as `validate` does, and each of its steps against the task's own.

    Where the task can be set to an observation (`env.state_at`), `env.step` says what follows from
    each observation and action. Elsewhere, and without actions, this is `validate`. Rewards that
    are absent and successors that nobody observed are not compared. A task that draws random
    numbers in `step` cannot be checked so: use `validate`. Rounding may decide whether an episode
    ends, so a step also passes if it is the task's answer to an observation a few roundings away.

    Args:
        demonstrations: the pool.
        env: the task.
        params: its parameters, default `env.default_params`.

    Raises:
        ValueError: as `validate`, or for the first step that is not the task's, naming the episode,
            the step, the field, its value, the task's value and the tolerance.
        TypeError: as `validate`.
    """
    validate(demonstrations, env.spec)
    if isinstance(env, HostEnv) or not can_be_repeated(demonstrations, env):
        return
    made = jax.tree.map(np.asarray, demonstrations.transition)
    found = np.column_stack([made.next_observation, made.reward, made.terminated])
    expected = steps(env, env.default_params if params is None else params, made)
    tolerance = rounding.tolerance(found)
    # What was not observed is not compared.
    found = np.where(np.isnan(found), expected[0], found)
    unseen = unobserved(demonstrations)
    found[unseen, : env.spec.observation_dim] = expected[0, unseen, : env.spec.observation_dim]
    # NaN agrees with nothing.
    differs = ~(np.abs(found - expected) <= tolerance)
    wrong = np.flatnonzero(differs.any(axis=-1).all(axis=0))
    if wrong.size:
        row = wrong[0]
        column = np.flatnonzero(differs[0, row])[0]
        names = [f"next_observation[{i}]" for i in range(env.spec.observation_dim)]
        raise ValueError(
            f"{_place(np.asarray(demonstrations.episode), row)}: "
            f"{[*names, 'reward', 'terminated'][column]} is {found[row, column]:.7g}, "
            f"{env.spec.id} makes it {expected[0, row, column]:.7g} "
            f"(tolerance {tolerance[row, column]:.1e})"
        )


def steps(env: Env, params: Any, made: Transition) -> np.ndarray:
    """What the task answers to each observation, and to two a few roundings away.

    Next observation, reward and terminated side by side, `[3, N, O + 2]`.
    """
    observation, action = (x.astype(np.float32) for x in (made.observation, made.action))
    nudge = (4.0 / rounding.ROUNDINGS * rounding.tolerance(observation)).astype(np.float32)

    def step(observation: jax.Array, action: jax.Array) -> jax.Array:
        answer = step_from(env, params, observation, action)
        return jnp.concatenate([answer.observation, jnp.stack([answer.reward, answer.terminated])])

    def nudged(sign: jax.Array) -> jax.Array:
        return jax.vmap(step)(observation + sign * nudge, action)

    return np.asarray(jax.lax.map(nudged, np.array([0.0, -1.0, 1.0], np.float32)), np.float64)


def unobserved(demonstrations: Demonstrations) -> np.ndarray:
    """`[N]` bool: the last steps of episodes whose successor nobody observed."""
    made, episode = demonstrations.transition, np.asarray(demonstrations.episode)
    repeated = (np.asarray(made.next_observation) == np.asarray(made.observation)).all(axis=-1)
    last = np.r_[episode[1:] != episode[:-1], True]
    return last & repeated & bool(demonstrations.metadata.get(REPEATED, 0))


def _place(episode: np.ndarray, row: Any) -> str:
    return f"episode {episode[row]}, step {row - np.searchsorted(episode, episode[row])}"
