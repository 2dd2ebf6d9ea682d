"""`python -m benchmarks.checkpoint_cost`: what checkpoints cost a run, with against without."""

import dataclasses
import statistics
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import tyro
from rich.console import Console

from benchmarks import measuring, ours
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells.compiled import CompiledMethod
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import compile_cache
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import checkpoints
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.training.settings import Settings


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure, and where to write it.

    Attributes:
        seeds: Learners of the cell, DDPG as `run_grid` trains it, on every core.
        steps: Steps of each; the replay saved is the main job's, of 12,000.
        every: Seconds between checkpoints: far more of them than a run makes, so that their cost
            shows.
        rounds: How often the cell is trained with and without, in turn.
        json: File for the measurements.
    """

    seeds: int = 100
    steps: int = 4_000
    every: float = 2.0
    rounds: int = 5
    json: Path | None = None


class _Timed(Checkpointer):
    """Notes how long training stood still for each checkpoint."""

    blocked: float = 0.0
    saved: int = 0

    def save_if_due(self, step, take):
        began = time.perf_counter()
        due = time.monotonic() >= self._due
        super().save_if_due(step, take)
        self.blocked += time.perf_counter() - began
        self.saved += due


def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit code."""
    options = tyro.cli(Options, prog="python -m benchmarks.checkpoint_cost", args=arguments)
    compile_cache.use_cache()
    jax.config.update("jax_num_cpu_devices", max(1, measuring.cores()))
    compiled = ours.compile_programs("ddpg", Settings(), jax.devices(), seeds_count=options.seeds)
    try:
        measured = measure(options, compiled)
    except UserError as error:
        print(f"checkpoint_cost: {error}", file=sys.stderr)
        return 2
    result = measuring.heading("checkpoint_cost") | measured
    console = Console()
    console.print(
        f"{result['checkpoint_bytes'] / 1e6:.0f} MB a checkpoint, {result['checkpoints']} of them: "
        f"training stood still for {result['blocked_seconds']:.3f} s each; one every "
        f"{options.every:g} s took {result['cost']:.1%} ({result['cost_low']:.1%} to "
        f"{result['cost_high']:.1%} over {options.rounds} rounds) of the time. At one every "
        f"{StudyConfig.checkpoint_every:g} s, the default: {result['cost_by_default']:.2%}.",
        highlight=False,
    )
    if options.json is not None:
        measuring.write(result, options.json)
    return 0


def measure(options: Options, compiled: CompiledMethod) -> dict[str, Any]:
    """Train the cell with and without, in turn.

    Raises:
        UserError: if it trains for less time than one checkpoint takes to fall due.
    """

    def seconds(checkpointer: Checkpointer | None) -> float:
        began = time.perf_counter()
        cell_lib.train(
            compiled,
            jax.random.key(0),
            None,
            0,
            seeds_count=options.seeds,
            budget=Budget(options.steps, None, 250, 10),
            threshold=0.0,
            report=lambda progress: None,
            checkpointer=checkpointer,
        )
        if checkpointer is not None:
            checkpointer.wait()
        return time.perf_counter() - began

    seconds(None)
    ratios, checkpointers, size, kept = [], [], 0, 1
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.rounds):
            checkpointer = _Timed(
                Path(folder) / str(number),
                {},
                every=options.every,
                interruption=Interruption(),
                say=lambda line: print(line, file=sys.stderr),
            )
            without = seconds(None)
            ratios.append(seconds(checkpointer) / without)
            if not checkpointer.saved:
                raise UserError(
                    f"--every: none was due in {without:.1f} s of training; ask for more --steps"
                )
            checkpointers.append(checkpointer)
            size = sum(
                path.stat().st_size for path in checkpointer.folder.rglob("*") if path.is_file()
            )
            kept = len(list(checkpointer.folder.iterdir()))
    count = sum(checkpointer.saved for checkpointer in checkpointers)
    cost = statistics.median(ratios) - 1.0
    return {
        "seeds": options.seeds,
        "steps": options.steps,
        "every_seconds": options.every,
        "rounds": options.rounds,
        "checkpoints": count,
        "checkpoint_bytes": size // kept,
        "kept": checkpoints.KEPT,
        "blocked_seconds": sum(checkpointer.blocked for checkpointer in checkpointers) / count,
        "cost": cost,
        "cost_low": min(ratios) - 1.0,
        "cost_high": max(ratios) - 1.0,
        "cost_by_default": cost * options.every / StudyConfig.checkpoint_every,
    }


if __name__ == "__main__":
    sys.exit(main())
