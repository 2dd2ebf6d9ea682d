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
            npz.save,
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
        ValueError: naming the source and the format it was read as: for a source that no format
            recognises, damaged or inconsistent ones, and pools that do not fit the task.
        OSError: if a file cannot be read.
        ModuleNotFoundError: naming the extra that the format needs.
    """
    name = recognised(source) if format is None else format
    chosen, task = FORMATS[name], env.spec if isinstance(env, Env | HostEnv) else env
    shown = source if isinstance(source, str | Path) else f"the {type(source).__name__}"
    try:
        pool = chosen.read(source, task)
        validation.validate(pool)
        if isinstance(task, EnvSpec):
            pool = _held_to(pool, task, env, actions)
    except ModuleNotFoundError as error:
        raise ModuleNotFoundError(
            f"{shown}: to read {chosen.description} install cmedirl-jax[{chosen.package}] ({error})"
        ) from error
    except ValueError as error:
        hint = "" if format else "; give format if it is another one"
        raise ValueError(f"{shown}, read as {name}: {error}{hint}") from error
    return pool


def _held_to(pool: Demonstrations, spec: EnvSpec, env: Any, actions: Actions) -> Demonstrations:
    if actions == "clip":
        pool = completion.clip(pool, spec)
    validation.validate(pool, spec)
    return completion.complete(pool, env) if isinstance(env, Env | HostEnv) else pool


def recognised(source: Any) -> str:
    """The name of the format that a source is in, by the looks of it.

    Raises:
        ValueError: for none.
    """
    for name, format in FORMATS.items():
        if format.recognises(source):
            return name
    found = (
        f"{source}: no" if isinstance(source, str | Path) else f"a {type(source).__name__} is no"
    )
    held = sorted(arrays.names_in(source))
    arrays_held = f", with arrays {', '.join(held)}" * bool(held)
    raise ValueError(
        f"{found} demonstrations of a known format{arrays_held}; there are: {', '.join(FORMATS)}"
    )
