"""What a format of demonstrations is."""

import contextlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Protocol

from cmedirl_jax.types import Demonstrations, EnvSpec


class Read(Protocol):
    """Read demonstrations."""

    def __call__(self, source: Any, env: str | EnvSpec | None) -> Demonstrations:
        """Read them.

        Args:
            source: a path, an id or an object in memory.
            env: names their task where the source does not.

        Raises:
            ValueError: for a source that is damaged or another format's, or that names no task
                where `env` is None.
            OSError: for a source that cannot be read.
            ModuleNotFoundError: where a package is missing.
        """
        ...


class Format(NamedTuple):
    """A format of demonstrations.

    Attributes:
        description: what it is, in a line.
        recognises: `(source) -> bool`, by a look at a path's name or first bytes, an id or an
            object in memory; raises nothing.
        read: see `Read`.
        writes: `(target) -> bool`: whether a target's name, a path or an id, is that of this
            format; None for a format that is only read.
        write: `(target, demonstrations, spec)`. Raises ValueError for a pool or a target that the
            format does not take, OSError where it cannot be written, ModuleNotFoundError where a
            package is missing.
        package: the extra that it needs; None for none.
        in_memory: whether its sources are objects, and no paths or ids.
    """

    description: str
    recognises: Callable[[Any], bool]
    read: Read
    writes: Callable[[str], bool] | None = None
    write: Callable[[str, Demonstrations, EnvSpec], Any] | None = None
    package: str | None = None
    in_memory: bool = False


def is_file(source: Any, *endings: str) -> bool:
    """Whether a source is the path of a file with one of these endings."""
    if not isinstance(source, str | Path):
        return False
    path = Path(source)
    return path.suffix.lower() in endings and path.is_file()


@contextlib.contextmanager
def naming_damage(*others: type[Exception]) -> Iterator[None]:
    """Call a source damaged for which its reader raises something, which may be anything.

    Args:
        *others: errors that say nothing of damage, and stay as they are.

    Raises:
        ValueError: in place of the reader's error.
    """
    try:
        yield
    except others:
        raise
    except Exception as error:
        raise ValueError(f"it is damaged ({' '.join(str(error).split())[:200]})") from error


def named(env: str | EnvSpec | None) -> str | EnvSpec:
    """The task, for formats that do not hold its name.

    Raises:
        ValueError: if it was not given.
    """
    if env is None:
        raise ValueError("it does not name its task: give env")
    return env
