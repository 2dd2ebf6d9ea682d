"""The folder of a run: its configuration, its lock, and which files in it are the run's own."""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import json
import math
import shutil
import tempfile
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import filelock

from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import sealing

SCHEMA = 1
PACKAGES = (
    *("cmedirl-jax", "jax", "jaxlib", "flax", "optax"),
    *("chex", "gymnasium", "numpy", "orbax-checkpoint"),
)
FOLDERS = ("demonstrations", "checkpoints", "policies", "rewards", "figures")
FILES = ("config.json", "summary.csv", *sealing.FILES)
_LOCK = ".lock"
_NOT_COMPARED = (
    *("out", "devices", "distributed", "coordinator", "processes", "process_id"),
    "checkpoint_every",
)


def describe(config: StudyConfig) -> dict[str, Any]:
    """The fully resolved configuration as JSON values."""
    described = dataclasses.asdict(config)
    if config.demos is not None:
        # Another file under the same name is another configuration.
        with config.demos.open("rb") as file:
            described["demos_sha256"] = hashlib.file_digest(file, "sha256").hexdigest()
    return _plain(described)


def check(config: StudyConfig) -> None:
    """See that the run can use its folder, which need not be there yet; writes nothing.

    Raises:
        UserError: if it cannot be written, holds a run of another configuration, or what is no run.
    """
    folder = config.folder
    path = folder / "config.json"
    if not str(folder).isprintable():
        raise UserError(f"--out: {str(folder)!r} cannot be printed; give a plainer name")
    try:
        if path.exists():
            _compare(path, describe(config))
        elif folder.is_dir():
            _check_nothing_else_in(folder)
        for name in FOLDERS:
            if (folder / name).exists() and not (folder / name).is_dir():
                raise UserError(f"--out: {folder / name} is in the way; a folder belongs there")
        nearest = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise UserError(f"--out: cannot write to {folder} ({error.strerror})") from error


def _check_nothing_else_in(folder: Path) -> None:
    # A process that was killed before it had written its configuration may have been here.
    own = {_LOCK, sealing.partial(folder / "config.json").name}
    for path in sorted(folder.iterdir()):
        if path.name not in own:
            raise UserError(
                f"--out: {folder} holds {path.name} and no config.json of a run; choose another "
                "folder, which a run has to itself"
            )


@contextlib.contextmanager
def opened(config: StudyConfig) -> Iterator[Path]:
    """The run's folder with its config.json, held against other processes while in use.

    A `UserError` before the first cell is finished leaves what was there before, and nothing else.

    Raises:
        UserError: as `check`, and if another process holds the folder.
    """
    check(config)
    folder = config.folder
    made = [path for path in (folder, *folder.absolute().parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out: cannot write to {folder} ({error.strerror})") from error
    before = set(folder.iterdir())
    with _held(folder):
        try:
            # Once more: another process may have been here since.
            check(config)
            sealing.finished(folder)
            _clean(folder)
            _configure(config)
            yield folder
        except UserError:
            if not sealing.begun(folder):
                _remove({folder / name for name in (*FOLDERS, *FILES, _LOCK)} - before)
                # What somebody else put there meanwhile stays, and so does its folder.
                with contextlib.suppress(OSError):
                    for path in made:
                        path.rmdir()
            raise


@contextlib.contextmanager
def _held(folder: Path) -> Iterator[None]:
    # The operating system gives the lock up when its process ends, however that ends.
    lock = filelock.FileLock(folder / _LOCK)
    try:
        lock.acquire(blocking=False)
    except filelock.Timeout as error:
        raise UserError(f"--out: another process is at work in {folder}") from error
    except OSError as error:
        raise UserError(f"--out: cannot lock {folder / _LOCK} ({error.strerror})") from error
    try:
        yield
    finally:
        lock.release()


def _clean(folder: Path) -> None:
    """Remove what a process that was killed while writing left behind."""
    _remove(sealing.partial(folder / name) for name in FILES)
    for pattern in (
        "demonstrations/*.partial",
        "policies/*.orbax-checkpoint-tmp*",
        "rewards/*.orbax-checkpoint-tmp*",
    ):
        _remove(folder.glob(pattern))


def _remove(paths: Iterable[Path]) -> None:
    for path in paths:
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


def _configure(config: StudyConfig) -> None:
    path = config.folder / "config.json"
    if not path.exists():
        described = {"schema": SCHEMA, "config": describe(config), "versions": versions()}
        with sealing.replacing(path) as partial:
            partial.write_text(json.dumps(described, indent=2) + "\n")


def versions() -> dict[str, str]:
    """Of the packages that a run's numbers depend on."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def other_versions(folder: Path) -> dict[str, str]:
    """The versions that began the run, of packages which have another one now."""
    began = json.loads((folder / "config.json").read_text())["versions"]
    now = versions()
    return {name: version for name, version in began.items() if now.get(name) != version}


def identity(config: StudyConfig) -> dict[str, Any]:
    """What a checkpoint must share with a run that goes on from it."""
    compared = {
        name: value for name, value in _flat(describe(config)).items() if name not in _NOT_COMPARED
    }
    digest = hashlib.sha256(json.dumps(compared, sort_keys=True).encode()).hexdigest()
    return {"config": digest, **versions()}


def _compare(path: Path, described: dict[str, Any]) -> None:
    try:
        written = json.loads(path.read_text())
        schema, before = written["schema"], _flat(written["config"])
        if not isinstance(written["versions"], dict):
            raise TypeError("versions")
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"--out: {path} is not a readable configuration ({error})") from error
    if schema != SCHEMA:
        raise UserError(f"--out: {path} has schema {schema!r}, this version writes {SCHEMA}")
    now = _flat(described)
    for name in sorted(before.keys() | now.keys()):
        if name not in _NOT_COMPARED and before.get(name) != now.get(name):
            raise UserError(
                f"--out: {path.parent} holds a run with {_option(name)} {before.get(name)}, not "
                f"{now.get(name)}; choose another folder or the same configuration"
            )


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return str(value) if isinstance(value, Path) else value


def _flat(nested: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = {}
    for name, value in nested.items():
        if isinstance(value, dict):
            flat |= _flat(value, "" if name == "settings" else f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
