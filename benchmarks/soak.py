"""`python -m benchmarks.soak`: what a process holds while it trains thousands of seeds."""

import dataclasses
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import psutil
import tyro

from benchmarks import measuring, plots
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.storage import outputs


@dataclasses.dataclass(frozen=True)
class Options:
    """How much to run, and where to write the measurements.

    Attributes:
        cells: Cells to train, one after the other: HS-ME-DDPG, smoke preset, with 1, 2, 3, ...
            demonstrations.
        seeds: Seeds of each cell.
        json: File for the measurements; a plot is drawn beside it.
    """

    cells: int = 20
    seeds: int = 100
    json: Path | None = None


class Sample(NamedTuple):
    """What the process held at one moment."""

    seconds: float
    cells: int
    resident_bytes: int
    open_files: int
    threads: int


@ending.in_a_line("soak")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run and watch; returns the run's exit code."""
    options = tyro.cli(
        Options, prog="python -m benchmarks.soak", description=__doc__, args=arguments
    )
    outputs.check("json", options.json)
    with tempfile.TemporaryDirectory() as folder:
        code, samples = watch(options, Path(folder) / "run")
    if code:
        return code
    growth = growth_per_cell(samples)
    most = max(sample.resident_bytes for sample in samples)
    middle, *_, last = least_per_cell(samples)[options.cells // 2 :]
    if options.json is not None:
        result = measuring.heading("soak") | {
            "growth_bytes_per_cell": growth,
            "samples": [sample._asdict() for sample in samples],
        }
        measuring.write(result, options.json)
        plots.soak(result["samples"], options.json.with_suffix(".png"))
    screen.say(
        screen.console(),
        f"{options.cells * options.seeds:,} seeds: {most / 2**20:.0f} MiB at most, "
        f"{growth / 2**20:+.2f} MiB a cell once a quarter is done; "
        f"{middle.open_files} open files half-way, {last.open_files} at the end",
    )
    return 0


def watch(options: Options, run: Path) -> tuple[int, list[Sample]]:
    """Train the cells in a process of their own, saving after every chunk; sample it each second.

    Returns:
        The process's exit code and the samples.
    """
    command = [
        *(sys.executable, "-m", "experiments.run_grid", "--preset", "smoke", "--out", str(run)),
        *("--methods", "hs-me-ddpg", "--seeds", str(options.seeds), "--checkpoint-every", "0"),
        *("--n-demos", *(str(1 + number) for number in range(options.cells))),
    ]
    began, samples = time.monotonic(), []
    with subprocess.Popen(command) as process:
        watched = psutil.Process(process.pid)
        while process.poll() is None:
            with watched.oneshot():
                sample = Sample(
                    time.monotonic() - began,
                    len(list(run.glob("cells/[!.]*"))),
                    watched.memory_info().rss,
                    watched.num_fds(),
                    watched.num_threads(),
                )
            samples.append(sample)
            time.sleep(1.0)
    # The last sample may show a process that was already ending.
    return process.returncode, samples[:-1]


def growth_per_cell(samples: Sequence[Sample]) -> float:
    """Slope of the resident bytes over finished cells, after the first quarter of the cells."""
    least = least_per_cell(samples)
    late = [sample for sample in least if sample.cells >= least[-1].cells / 4]
    return float(np.polyfit([s.cells for s in late], [s.resident_bytes for s in late], 1)[0])


def least_per_cell(samples: Sequence[Sample]) -> list[Sample]:
    """The least that was held at each number of finished cells: leaves out what is held briefly."""
    by_cell: dict[int, list[Sample]] = {}
    for sample in samples:
        by_cell.setdefault(sample.cells, []).append(sample)
    return [Sample(*map(min, zip(*by_cell[number], strict=True))) for number in sorted(by_cell)]


if __name__ == "__main__":
    sys.exit(main())
