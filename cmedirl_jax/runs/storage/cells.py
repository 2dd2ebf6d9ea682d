"""The finished cells of a run, each a sealed folder `cells/NAME`.

    evaluations.parquet, episodes.parquet, seeds.parquet    its rows of the run's tables
    policies/, rewards/    each seed's best actor, and its reward where the method has one; by orbax
    seal.json    its key, the task and the settings, the packages' versions, every file's digest

A cell is a method with a number of demonstrations and a block of seeds. Seed i draws its random
numbers from i alone, so that further seeds are a further block.
"""

import io
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import plain, sealing
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import EnvSpec

FOLDER = "cells"
TABLES = ("evaluations", "episodes", "seeds")


class CellKey(NamedTuple):
    """Which cell it is.

    Attributes:
        study: the study's seed.
        expert: who demonstrated, "none" for a method without demonstrations.
        method: the method's name.
        n_demos: demonstrations of each seed, 0 for a method without.
        first_seed: the first of its seeds.
        seeds: how many it has.
    """

    study: int
    expert: str
    method: str
    n_demos: int
    first_seed: int
    seeds: int

    @property
    def seed_range(self) -> range:
        """Its seeds."""
        return range(self.first_seed, self.first_seed + self.seeds)

    def __str__(self) -> str:
        demonstrations = f", n_demos {self.n_demos}" if self.n_demos else ""
        last = self.seed_range[-1]
        return f"{self.method}{demonstrations}, seeds {self.first_seed} to {last}"


class SavedCell(NamedTuple):
    """A finished cell on disk.

    Attributes:
        path: its folder.
        key: which cell it is.
        seal: the content of its seal.
    """

    path: Path
    key: CellKey
    seal: dict[str, Any]

    def table(self, name: str) -> Any:
        """Its rows of one of the tables, a polars frame."""
        import polars as pl

        # Through memory: polars would take brackets in a path for a pattern.
        return pl.read_parquet(io.BytesIO((self.path / f"{name}.parquet").read_bytes()))

    def task(self) -> EnvSpec:
        """The environment's specification, as it was trained with."""
        return plain.spec(self.seal["task"])

    def settings(self) -> Settings:
        """The settings that it was trained with.

        Raises:
            ValueError: if this version has other settings.
        """
        return plain.settings(Settings, self.seal["settings"])


def asked(methods: Sequence[str], n_demos: Sequence[int]) -> list[tuple[str, int]]:
    """Method and number of demonstrations of every cell; 0 for a method without, which has one."""
    return [
        (method, number)
        for method in methods
        for number in (n_demos if METHODS[method].uses_demonstrations else (0,))
    ]


def name(method: str, n_demos: int, first_seed: int, seeds: int) -> str:
    """The name of a cell's folder."""
    return f"{stem(method, n_demos)}-seeds-{first_seed}-{first_seed + seeds - 1}"


def stem(method: str, n_demos: int) -> str:
    """A cell's name without its seeds."""
    return f"{method}-n{n_demos}" if n_demos else method


def save(
    folder: Path,
    key: CellKey,
    description: dict[str, Any],
    tables: dict[str, Any],
    trees: dict[str, Any],
    call: Callable[..., Any] = lambda function, *arguments: function(*arguments),
) -> None:
    """Write a finished cell, which appears in one move.

    Args:
        folder: the run's.
        key: which cell it is.
        description: further JSON values for the seal: `task`, `settings`, `versions`.
        tables: its rows of each table, polars frames.
        trees: pytrees of arrays `[seeds, ...]` by the name of their folder; None for none.
        call: calls orbax.
    """
    path = folder / FOLDER / name(key.method, key.n_demos, key.first_seed, key.seeds)
    with sealing.sealed(path, {"cell": key._asdict(), **description}) as unfinished:
        for table, rows in tables.items():
            # Through memory: a full disk is an OSError then, not an error of polars.
            buffer = io.BytesIO()
            rows.write_parquet(buffer)
            (unfinished / f"{table}.parquet").write_bytes(buffer.getvalue())
        for tree, arrays in trees.items():
            if arrays is not None:
                call(checkpoint.save, unfinished / tree, arrays)


def finished(folder: Path) -> list[SavedCell]:
    """The finished cells of a run, in order of their names; each file is checked.

    Raises:
        UserError: if one is damaged, or of another version.
    """
    cells = []
    for path in sorted(folder.glob(f"{FOLDER}/*")):
        if path.name.startswith(".") or not path.is_dir():
            continue
        try:
            seal = sealing.read(path)
            cells.append(SavedCell(path, CellKey(**seal["cell"]), seal))
        except (sealing.Damaged, KeyError, TypeError) as error:
            reason = error if isinstance(error, sealing.Damaged) else "is no cell of a run"
            raise UserError(
                f"{path} {reason}; bring it back, or remove it to train the cell again"
            ) from error
        except sealing.OtherSchema as error:
            raise UserError(f"{path} {error}") from error
        except OSError as error:
            raise UserError(f"{path} cannot be read ({error.strerror})") from error
    return cells


def any_begun(folder: Path) -> bool:
    """Whether a cell may be finished."""
    return any(folder.glob(f"{FOLDER}/*/{sealing.SEAL}"))


def missing_blocks(
    folder: Path,
    keys: Iterable[CellKey],
    method: str,
    n_demos: int,
    seeds: int,
    at_once: int | None = None,
) -> list[range]:
    """The blocks of seeds that have to be trained so that there are `seeds` of them, in order.

    A block that has a checkpoint stays as it was begun.

    Args:
        folder: the run's.
        keys: of the finished cells.
        method: the method's name.
        n_demos: demonstrations of each seed.
        seeds: how many are asked for.
        at_once: the most of a new block; None: as many as there are.
    """
    done = {
        key.first_seed: key.seeds for key in keys if (key.method, key.n_demos) == (method, n_demos)
    }
    pattern = re.compile(re.escape(stem(method, n_demos)) + r"-seeds-(\d+)-(\d+)")
    begun: dict[int, int] = {}
    for path in folder.glob("checkpoints/*"):
        if block := pattern.fullmatch(path.name):
            begun[int(block[1])] = int(block[2]) + 1 - int(block[1])
    blocks, first = [], 0
    while first < seeds:
        size = done.get(first)
        if size is None:
            size = begun.get(first, at_once or seeds)
            size = size if first + size <= seeds else seeds - first
            blocks.append(range(first, first + size))
        first += size
    return blocks
