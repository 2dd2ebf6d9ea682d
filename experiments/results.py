"""The folder of a run: which cells are finished, its tables, its policies.

A finished cell is one whose rows are in all tables; evaluations.parquet is written last, and every
table is replaced whole, so a run that was cut off leaves only finished cells behind.
"""

import contextlib
import dataclasses
import hashlib
import importlib.metadata
import io
import json
import math
import os
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import filelock
import polars as pl

from experiments.errors import UserError
from experiments.presets import Grid

SCHEMA = 1
PACKAGES = (
    *("cmedirl-jax", "jax", "jaxlib", "flax", "optax"),
    *("chex", "gymnasium", "numpy", "orbax-checkpoint"),
)
TABLES = ("seeds", "episodes", "evaluations")
"""In the order they are written."""

COLUMNS = {
    "seeds": (
        *("seed", "env_steps", "episodes", "demonstration_steps", "expert_steps", "diverged"),
        *("best_return", "gymnasium_return", "gymnasium_difference"),
    ),
    "episodes": ("seed", "episode", "env_step", "return"),
    "evaluations": ("expert", "protocol", "seed", "env_step", "episode", "return_mean"),
}
"""What the summary and the figures read of each table, beside `method` and `n_demos`."""

DAMAGED = (OSError, pl.exceptions.PolarsError, pl.exceptions.PanicException)
"""What reading a damaged table raises; polars panics where a flipped bit breaks its assumptions."""

_LOCK = ".lock"
_NOT_COMPARED = (
    *("out", "devices", "distributed", "coordinator", "processes", "process_id"),
    "checkpoint_every",
)


def describe(grid: Grid) -> dict[str, Any]:
    """The fully resolved configuration as JSON values."""
    config = dataclasses.asdict(grid)
    if grid.demos is not None:
        # Another file under the same name is another configuration.
        with grid.demos.open("rb") as file:
            config["demos_sha256"] = hashlib.file_digest(file, "sha256").hexdigest()
    return _plain(config)


def check_folder(grid: Grid) -> None:
    """See that the run can use its folder, which need not be there yet; writes nothing.

    Raises:
        UserError: if it cannot be written, or holds a run of another configuration.
    """
    folder = grid.folder
    path = folder / "config.json"
    try:
        if path.exists():
            _compare(path, describe(grid))
        elif any((folder / f"{name}.parquet").exists() for name in TABLES):
            raise UserError(f"--out: {folder} holds tables without their config.json")
        nearest = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
        with tempfile.TemporaryFile(dir=nearest):
            pass
    except OSError as error:
        raise UserError(f"--out: cannot write to {folder} ({error.strerror})") from error


@contextlib.contextmanager
def opened(grid: Grid) -> Iterator[Path]:
    """The run's folder with its config.json, held against other processes while in use.

    A `UserError` before the first cell is finished leaves what was there before, and nothing else.

    Raises:
        UserError: as `check_folder`, and if another process holds the folder.
    """
    check_folder(grid)
    folder = grid.folder
    made = [path for path in (folder, *folder.absolute().parents) if not path.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"--out: cannot write to {folder} ({error.strerror})") from error
    before = set(folder.iterdir())
    with _held(folder):
        try:
            # Once more: another process may have been here since.
            check_folder(grid)
            _clean(folder)
            _configure(grid)
            yield folder
        except UserError:
            new = set(folder.iterdir()) - before
            if not (folder / "evaluations.parquet").exists():
                for path in new:
                    shutil.rmtree(path) if path.is_dir() else path.unlink()
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
    for pattern in (".*.partial", "*/*.partial", "*/*.orbax-checkpoint-tmp*"):
        for path in folder.glob(pattern):
            shutil.rmtree(path) if path.is_dir() else path.unlink()


def _configure(grid: Grid) -> None:
    path = grid.folder / "config.json"
    if not path.exists():
        config = {"schema": SCHEMA, "config": describe(grid), "versions": versions()}
        with replacing(path) as partial:
            partial.write_text(json.dumps(config, indent=2) + "\n")


def versions() -> dict[str, str]:
    """Of the packages that a run's numbers depend on."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}


def other_versions(folder: Path) -> dict[str, str]:
    """The versions that began the run, of packages which have another one now."""
    began = json.loads((folder / "config.json").read_text())["versions"]
    now = versions()
    return {name: version for name, version in began.items() if now.get(name) != version}


def identity(grid: Grid) -> dict[str, Any]:
    """What a checkpoint must share with a run that goes on from it."""
    compared = {
        name: value for name, value in _flat(describe(grid)).items() if name not in _NOT_COMPARED
    }
    digest = hashlib.sha256(json.dumps(compared, sort_keys=True).encode()).hexdigest()
    return {"config": digest, **versions()}


def _compare(path: Path, config: dict[str, Any]) -> None:
    try:
        written = json.loads(path.read_text())
        schema, before = written["schema"], _flat(written["config"])
        dict(written["versions"])
    except (OSError, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"--out: {path} is not a readable configuration ({error})") from error
    if schema != SCHEMA:
        raise UserError(f"--out: {path} has schema {schema!r}, this version writes {SCHEMA}")
    now = _flat(config)
    for name in sorted(before.keys() | now.keys()):
        if name not in _NOT_COMPARED and before.get(name) != now.get(name):
            raise UserError(
                f"--out: {path.parent} holds a run with {_option(name)} {before.get(name)}, not "
                f"{now.get(name)}; choose another folder or the same configuration"
            )


def read(folder: Path, name: str) -> pl.DataFrame | None:
    """A table of the run, with its finished cells alone; None before the first cell is finished."""
    path = folder / f"{name}.parquet"
    done = folder / "evaluations.parquet"
    if not done.exists():
        return None
    table = pl.read_parquet(path)
    cells = pl.scan_parquet(done).select("method", "n_demos").unique().collect()
    return table.join(cells, on=["method", "n_demos"], how="semi", maintain_order="left")


def finished(folder: Path) -> set[tuple[str, int]]:
    """`(method, n_demos)` of the finished cells.

    Raises:
        UserError: if a table is damaged.
    """
    try:
        tables = {name: read(folder, name) for name in TABLES}
        for name, table in tables.items():
            if table is not None:
                table.select(COLUMNS[name])
        evaluations = tables["evaluations"]
        if evaluations is None:
            return set()
        return set(evaluations.select("method", "n_demos").unique().iter_rows())
    except DAMAGED as error:
        reason = str(error).splitlines()[0]
        raise UserError(f"--out: {folder} holds a damaged table ({reason})") from error


def append(folder: Path, rows: dict[str, pl.DataFrame]) -> None:
    """Add a finished cell's rows to every table."""
    for name in TABLES:
        before = read(folder, name)
        table = rows[name] if before is None else pl.concat([before, rows[name]])
        # Through memory: a full disk is an OSError then, not one of polars' own.
        buffer = io.BytesIO()
        table.write_parquet(buffer)
        with replacing(folder / f"{name}.parquet") as partial:
            partial.write_bytes(buffer.getvalue())


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to, which then replaces `path` in one move; an error leaves nothing."""
    partial = path.with_name(f".{path.name}.partial")
    try:
        yield partial
        # Or a power cut might leave the name without the content.
        with partial.open("rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: _plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return str(value) if isinstance(value, Path) else value


def _flat(config: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    flat = {}
    for name, value in config.items():
        if isinstance(value, dict):
            flat |= _flat(value, "" if name == "settings" else f"{prefix}{name}.")
        else:
            flat[prefix + name] = value
    return flat


def _option(name: str) -> str:
    return "--" + name.replace("_", "-")
