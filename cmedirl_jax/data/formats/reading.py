"""Reading demonstrations of any format."""

from pathlib import Path
from typing import Any, Literal

from cmedirl_jax.data import completion, validation
from cmedirl_jax.data.formats import arrays, minari, npz, tables
from cmedirl_jax.data.formats.base import Format
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.registries import Registry
from cmedirl_jax.types import Demonstrations, EnvSpec

Actions = Literal["refuse", "clip"]

FORMATS: Registry[Format] = Registry(
    "format of demonstrations",
    {
        "npz": Format(
            "an npz file that `demonstrations.save` wrote",
            lambda source: {"header", "next_observation"} <= arrays.names_in(source),
            lambda source, env: npz.load(source),
            lambda target: Path(target).suffix.lower() == ".npz",
            lambda target, demonstrations, spec: npz.save(target, demonstrations),
        ),
        "imitation": arrays.IMITATION,
        "imitation-folder": tables.IMITATION_FOLDER,
        "stable-baselines": arrays.STABLE_BASELINES,
        "d4rl-file": arrays.D4RL_FILE,
        "table": tables.TABLE,
        "minari": minari.MINARI,
        "d4rl": arrays.D4RL,
        "trajectories": arrays.TRAJECTORIES,
    },
)
"""Maps each name to its format; the first that recognises a source reads it."""


def read(
    source: Any,
    format: str | None = None,
    *,
    env: str | Env | HostEnv | EnvSpec | None = None,
    actions: Actions = "refuse",
) -> Demonstrations:
    """Read demonstrations of any format, and hold them to their task.

    Args:
        source: a path, an id of Minari's, a dictionary of d4rl's arrays, or a list of trajectories.
        format: a name in `FORMATS`; default what the source looks like.
        env: the task, its specification, or its name alone, for sources that do not name it. With a
            task what is absent is computed where it can be (`completion.complete`). With a
            specification or a task the pool is held to its sizes and bounds.
        actions: what happens to actions out of bounds: the pool is refused, or they are clipped.

    Raises:
        ValueError: as `parse`, and for pools that do not fit the task.
        OSError: as `parse`.
        ModuleNotFoundError: as `parse`.
        TypeError: as `validation.validate`.
    """
    task = env.spec if isinstance(env, Env | HostEnv) else env
    pool = parse(source, format, task)
    if not isinstance(task, EnvSpec):
        return pool
    if actions == "clip":
        pool = completion.clip(pool, task)
    try:
        validation.validate(pool, task)
    except ValueError as error:
        raise ValueError(f"{_shown(source)}: {error}") from error
    return completion.complete(pool, env) if isinstance(env, Env | HostEnv) else pool


def parse(
    source: Any, format: str | None = None, env: str | EnvSpec | None = None
) -> Demonstrations:
    """Read demonstrations of any format; they are valid in themselves.

    Args:
        source: as in `read`.
        format: likewise.
        env: the task's name, or its specification, which state-only demonstrations need.

    Raises:
        ValueError: for an unknown format, one that is for other sources, or a source that no format
            recognises. For a damaged or inconsistent one, naming the source and the format it was
            read as.
        OSError: if a file cannot be read, or is not there.
        ModuleNotFoundError: naming the extra that the format needs.
    """
    name = recognised(source) if format is None else format
    chosen, shown = FORMATS[name], _shown(source)
    if isinstance(source, str | Path) == chosen.in_memory:
        raise ValueError(f"{shown}: format {name} is {chosen.description}; give another")
    try:
        pool = chosen.read(source, env)
        validation.validate(pool)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{shown}: to read {chosen.description} install cmedirl-jax[{chosen.package}] ({error})"
        ) from error
    except ValueError as error:
        if str(error).startswith(f"{shown}: "):
            raise
        hint = "" if format else "; give format if it is another one"
        raise ValueError(f"{shown}: read as {name}, {error}{hint}") from error
    return pool


def _shown(source: Any) -> str:
    """A source in a message."""
    return str(source) if isinstance(source, str | Path) else f"the {type(source).__name__}"


def recognised(source: Any) -> str:
    """The name of the format that a source is in, by the looks of it.

    Raises:
        ValueError: for none.
        FileNotFoundError: for a path that leads nowhere.
    """
    for name, format in FORMATS.items():
        if format.recognises(source):
            return name
    shown, there = _shown(source), ", ".join(FORMATS)
    if not isinstance(source, str | Path):
        raise ValueError(f"{shown} is no demonstrations of a known format; there are: {there}")
    path = Path(source)
    if not path.exists():
        raise FileNotFoundError(f"there is no file {shown}, nor a dataset of that name")
    if not path.is_file() and not path.is_dir():
        raise ValueError(f"{shown}: not a regular file")
    held = sorted(arrays.names_in(source))
    if path.suffix == ".npz" and not held:
        # Damaged, which reading it will say.
        return "npz"
    holding = f" (it holds {', '.join(held)})" * bool(held)
    raise ValueError(f"{shown}: no demonstrations of a known format{holding}; there are: {there}")
