"""`python -m benchmarks.checkpoint_cost`: the share of a run's time that checkpoints take."""

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

from benchmarks import measuring, ours
from cmedirl_jax.runs import start
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells.compiled import CompiledMethod
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import compile_cache, ending, screen, streams
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import checkpoints, outputs
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.training.settings import Settings


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure, and where to write it.

    Attributes:
        seeds: Learners of the cell: DDPG as `run_grid` trains it, on every core.
        steps: Environment steps of each. The replay has room for 12,000, as in the main job.
        every: Seconds between checkpoints. A run saves far less often; here the cost is to show.
        rounds: How often the cell is trained with and without checkpoints, in turn.
        json: File for the measurements.
    """

    seeds: int = 100
    steps: int = 4_000
    every: float = 2.0
    rounds: int = 5
    json: Path | None = None


class _Timed(Checkpointer):
    """A checkpointer that measures how long training stood still for it.

    Attributes:
        blocked: seconds in which training stood still.
        saved: how many checkpoints were taken.
    """

    blocked: float = 0.0
    saved: int = 0

    def save_if_due(self, step, take):
        began = time.perf_counter()
        due = time.monotonic() >= self._due
        super().save_if_due(step, take)
        self.blocked += time.perf_counter() - began
        self.saved += due


@ending.in_a_line("checkpoint_cost")
def main(arguments: Sequence[str] | None = None) -> int:
    """Measure and print; returns the exit code."""
    options = tyro.cli(
        Options, prog="python -m benchmarks.checkpoint_cost", description=__doc__, args=arguments
    )
    outputs.check("json", options.json)
    compile_cache.use_cache()
    jax.config.update("jax_num_cpu_devices", max(1, measuring.cores()))
    compiled = ours.compile_programs("ddpg", Settings(), start.devices(), seeds_count=options.seeds)
    result = measuring.heading("checkpoint_cost") | measure(options, compiled)
    if options.json is not None:
        measuring.write(result, options.json)
    screen.say(
        screen.console(),
        f"{result['checkpoint_bytes'] / 1e6:.0f} MB a checkpoint, {result['checkpoints']} of them: "
        f"training stood still for {result['blocked_seconds']:.3f} s each; one every "
        f"{options.every:g} s took {result['cost']:.1%} ({result['cost_low']:.1%} to "
        f"{result['cost_high']:.1%} over {options.rounds} rounds) of the time. At one every "
        f"{StudyConfig.checkpoint_every:g} s, the default: {result['cost_by_default']:.2%}.",
    )
    return 0


def measure(options: Options, compiled: CompiledMethod) -> dict[str, Any]:
    """Train the cell with and without checkpoints, in turn.

    Raises:
        UserError: if it trains for less time than one checkpoint takes to fall due.
    """
    # The first training compiles.
    train_seconds(options, compiled, None)
    ratios, checkpointers, sizes = [], [], []
    with tempfile.TemporaryDirectory() as folder:
        for number in range(options.rounds):
            checkpointer = _Timed(
                Path(folder) / str(number),
                {},
                every=options.every,
                interruption=Interruption(),
                say=streams.complain,
            )
            without = train_seconds(options, compiled, None)
            ratios.append(train_seconds(options, compiled, checkpointer) / without)
            if not checkpointer.saved:
                raise UserError(
                    f"--every: none was due in {without:.1f} s of training; ask for more --steps"
                )
            checkpointers.append(checkpointer)
            files = [path for path in checkpointer.folder.rglob("*") if path.is_file()]
            kept = len(list(checkpointer.folder.iterdir()))
            sizes.append(sum(path.stat().st_size for path in files) // kept)
    count = sum(checkpointer.saved for checkpointer in checkpointers)
    cost = statistics.median(ratios) - 1.0
    return {
        "seeds": options.seeds,
        "steps": options.steps,
        "every_seconds": options.every,
        "rounds": options.rounds,
        "checkpoints": count,
        "checkpoint_bytes": sizes[-1],
        "kept": checkpoints.KEPT,
        "blocked_seconds": sum(checkpointer.blocked for checkpointer in checkpointers) / count,
        "cost": cost,
        "cost_low": min(ratios) - 1.0,
        "cost_high": max(ratios) - 1.0,
        "cost_by_default": cost * options.every / StudyConfig.checkpoint_every,
    }


def train_seconds(
    options: Options, compiled: CompiledMethod, checkpointer: Checkpointer | None
) -> float:
    """How long the cell trains, until its last checkpoint is written."""
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


if __name__ == "__main__":
    sys.exit(main())
