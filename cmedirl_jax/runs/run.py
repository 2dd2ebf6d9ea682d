"""A whole run: it holds its folder, trains the cells that are missing, and concludes."""

import contextlib
import errno
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, TypeVar

import jax
from rich.console import Console

from cmedirl_jax.runs import train
from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.console import compile_cache, phases
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells, checkpoints
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.train import Cell
from cmedirl_jax.runs.validation import Plan
from cmedirl_jax.training.methods import METHODS

Concluded = TypeVar("Concluded")


def run(
    plan: Plan,
    devices: Sequence[Any],
    console: Console,
    interruption: Interruption,
    conclude: Callable[[Path], Concluded],
    cluster: Cluster = ALONE,
) -> Concluded | None:
    """Train the cells that are missing, then conclude.

    Args:
        plan: the run.
        devices: that share the seeds.
        console: where progress goes.
        interruption: the signals that have come.
        conclude: called last, on process 0 alone, with the run's folder: makes tables, figures and
            the summary from its cells. Called again at the next start if a signal ends it.
        cluster: the processes of the run.

    Returns:
        What `conclude` returned; None on the other processes.

    Raises:
        UserError: for a folder or a file that cannot be used.
        Interrupted: if a signal came; the training is saved.
        OSError: if a file could not be written; finished cells stay.
    """
    with contextlib.ExitStack() as stack:

        def enter() -> dict[str, Any]:
            finished = stack.enter_context(run_folder.opened(plan.folder, plan.config))
            return {
                "blocks": _missing(plan, finished),
                "began": run_folder.other_versions(plan.folder),
            }

        entered = cluster.from_writer(enter)
        todo = [
            Cell(METHODS[method], n_demos, range(first, stop))
            for method, n_demos, first, stop in entered["blocks"]
        ]
        if todo:
            kind = devices[0].platform.upper()
            console.print(f"{plan.seeds} seeds per cell on {len(devices)} {kind} device(s)")
            for name, version in entered["began"].items():
                console.print(f"This run was begun with {name} {version}", highlight=False)
            session = train.session_of(plan, devices, console, interruption, cluster)
            with (
                compile_cache.counted() as cost,
                phases.counted() as seconds,
                _within_memory(plan.folder),
            ):
                train.train_cells(session, todo)
            spent = ", ".join(f"{name} {took:.1f} s" for name, took in seconds.items())
            console.print(f"Time: {spent}", highlight=False)
            console.print(
                f"Compilation took {cost.seconds:.1f} s; {cost.hits} programs came from the cache, "
                f"{cost.misses} did not",
                highlight=False,
            )
        if interruption.came():
            interruption.stop()
        if not cluster.writer:
            return None
        interruption.release()
        names = [cell.path.name for cell in cells.finished(plan.folder)]
        run_folder.remove_checkpoints(plan.folder, names)
        run_folder.note_cells_asked(plan.folder, plan.config)
        return conclude(plan.folder)


def _missing(plan: Plan, finished: Sequence[cells.SavedCell]) -> list[tuple[str, int, int, int]]:
    """Method, number of demonstrations and block of seeds of each cell to be trained."""
    keys = [cell.key for cell in finished]
    return [
        (method, n_demos, block.start, block.stop)
        # Cells of equal N_T follow each other: their methods share a hot start.
        for method, n_demos in sorted(plan.asked, key=lambda cell: cell[1])
        for block in cells.missing_blocks(
            plan.folder, keys, method, n_demos, plan.seeds, plan.seeds_at_once
        )
    ]


@contextlib.contextmanager
def _within_memory(folder: Path) -> Iterator[None]:
    """Turn a lack of memory into a refusal, or into an OSError once something is saved."""
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        messages = ("RESOURCE_EXHAUSTED", "Out of memory")
        if not isinstance(error, MemoryError) and not any(m in str(error) for m in messages):
            raise
        if cells.any_begun(folder) or any((folder / checkpoints.FOLDER).glob("*/*")):
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)) from error
        raise UserError(
            "the machine's memory is too small for this; give fewer --seeds, --max-steps or "
            "--evaluation-starts, or smaller networks"
        ) from error
