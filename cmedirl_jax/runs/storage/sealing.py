"""The tables of a run, which hold its finished cells.

A cell is finished once its rows are in all tables. These are replaced one by one, each as a whole;
tables.json, written before them, has the digests of what was there and of what comes, so that a run
which was cut off in between is told from one whose files were damaged or changed.
"""

import contextlib
import hashlib
import io
import json
from collections.abc import Iterator
from pathlib import Path

import polars as pl

from cmedirl_jax.io import atomic
from cmedirl_jax.runs.errors import UserError

SCHEMA = 1
TABLES = ("seeds", "episodes", "evaluations")
"""In the order they are written."""
FILES = ("tables.json", *(f"{name}.parquet" for name in TABLES))


def begun(folder: Path) -> bool:
    """Whether a cell may be finished."""
    return (folder / "evaluations.parquet").exists()


def read(folder: Path) -> dict[str, pl.DataFrame]:
    """The tables of the run, with its finished cells alone; none before the first is finished.

    Raises:
        UserError: if a table is not as it was written.
    """
    contents = _verified(folder)
    if "evaluations" not in contents:
        return {}
    # Through memory: polars would take brackets in a path for a pattern.
    tables = {name: pl.read_parquet(io.BytesIO(contents[name])) for name in TABLES}
    cells = tables["evaluations"].select("method", "n_demos").unique()
    return {
        name: table.join(cells, on=["method", "n_demos"], how="semi", maintain_order="left")
        for name, table in tables.items()
    }


def finished(folder: Path) -> set[tuple[str, int]]:
    """`(method, n_demos)` of the finished cells.

    Raises:
        UserError: if a table is not as it was written.
    """
    try:
        tables = read(folder)
    except UserError as error:
        raise UserError(f"--out: {error}") from error
    if not tables:
        return set()
    return set(tables["evaluations"].select("method", "n_demos").unique().iter_rows())


def append(folder: Path, rows: dict[str, pl.DataFrame]) -> None:
    """Add a finished cell's rows to every table."""
    before, contents = read(folder), {}
    for name in TABLES:
        table = pl.concat([before[name], rows[name]]) if before else rows[name]
        # Through memory: a full disk is an OSError then, not one of polars' own.
        buffer = io.BytesIO()
        table.write_parquet(buffer)
        contents[name] = buffer.getvalue()
    digests = {name: [_digest(_content(folder, name)), _digest(contents[name])] for name in TABLES}
    with replacing(folder / "tables.json") as partial:
        partial.write_text(json.dumps({"schema": SCHEMA, "sha256": digests}, indent=2) + "\n")
    for name in TABLES:
        with replacing(folder / f"{name}.parquet") as partial:
            partial.write_bytes(contents[name])


def _verified(folder: Path) -> dict[str, bytes]:
    """The content of each table that is there."""
    digests = _digests(folder)
    while True:
        # The last first: a cell that is added meanwhile replaces them in their order.
        contents = {name: _content(folder, name) for name in reversed(TABLES)}
        before, digests = digests, _digests(folder)
        if before == digests:
            break
    found = [_digest(contents[name]) for name in TABLES]
    possible = [digests[name] for name in TABLES]
    # The first so many of them replaced: any number, but no other choice of them.
    for replaced in range(len(TABLES) + 1):
        if found == [pair[at < replaced] for at, pair in enumerate(possible)]:
            return {name: content for name, content in contents.items() if content is not None}
    known = list(zip(TABLES, found, possible, strict=True))
    foreign = [name for name, digest, pair in known if digest not in pair]
    older = [name for name, digest, pair in known if digest != pair[1]]
    name = (foreign or older)[0]
    raise UserError(f"{folder} holds a damaged table ({name}.parquet is not as it was written)")


def _digests(folder: Path) -> dict[str, tuple[str | None, str | None]]:
    """Of each table before and after the last cell was added."""
    path = folder / "tables.json"
    try:
        written = json.loads(path.read_bytes())
        schema, pairs = written["schema"], written["sha256"]
        digests = {name: (pairs[name][0], pairs[name][1]) for name in TABLES}
    except FileNotFoundError:
        return dict.fromkeys(TABLES, (None, None))
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from error
    except (ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise UserError(f"{folder} holds a damaged table (tables.json)") from error
    if schema != SCHEMA:
        raise UserError(f"{path} has schema {schema!r}, this version reads {SCHEMA}")
    return digests


def _content(folder: Path, name: str) -> bytes | None:
    path = folder / f"{name}.parquet"
    try:
        return path.read_bytes()
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{path} cannot be read ({error.strerror})") from error


def _digest(content: bytes | None) -> str | None:
    return None if content is None else hashlib.sha256(content).hexdigest()


def partial(path: Path) -> Path:
    """Where a file lies until it is whole."""
    return path.with_name(f".{path.name}.partial")


@contextlib.contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Give a path to write to, which then replaces `path` in one move; an error leaves nothing."""
    written = partial(path)
    try:
        yield written
        atomic.replace(written, path)
    finally:
        written.unlink(missing_ok=True)
