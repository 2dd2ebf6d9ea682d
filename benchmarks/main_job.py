"""`python -m benchmarks.main_job`: how long the main job takes, phase by phase, and its memory.

The main job is `run_grid` with its defaults. It runs in a process of its own, on every core. Its
wall time T is compared with a yardstick: a program that takes the same DDPG learning steps on one
core, at a rate R that is measured before and after. T R / N, with N the job's learning steps, is
the time that the job takes in units of one core's time for the bare steps.
"""

import contextlib
import dataclasses
import json
import os
import re
import shlex
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import polars as pl
import tyro
from rich import box
from rich.table import Table

from benchmarks import measuring, serving
from cmedirl_jax.runs.console import compile_cache, ending, phases, screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import outputs
from experiments import run_grid

_CHILD = "from benchmarks import main_job; main_job.work()"


@dataclasses.dataclass(frozen=True)
class Options:
    """What to run, and where to write what it took.

    Attributes:
        rounds: How often to run the job twice: with an empty compile cache (cold), and with the one
            that this left (warm).
        yardstick: Command that prints lines with "N steps/s", the last of which counts. It is run
            on one core, before and after each run.
        job: Further options of `run_grid`, in one string: --job="--preset smoke".
        json: File for the measurements.
    """

    rounds: int = 1
    yardstick: str | None = None
    job: str = ""
    json: Path | None = None


@ending.in_a_line("main_job")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the job, and print what it took; returns the exit code."""
    options = tyro.cli(
        Options, prog="python -m benchmarks.main_job", description=__doc__, args=arguments
    )
    outputs.check("json", options.json)
    job = shlex.split(options.job)
    # Refuse a wrong option before anything is run.
    run_grid.parse(job)
    runs: dict[str, list[dict[str, Any]]] = {"cold": [], "warm": []}
    for _ in range(options.rounds):
        with tempfile.TemporaryDirectory() as cache:
            for measured in runs.values():
                measured.append(run(job, cache, options.yardstick))
    if options.json is not None:
        result = measuring.heading("main_job") | {"runs": runs}
        measuring.write(result, options.json)
    screen.show(screen.console(), table(runs))
    return 0


def learning_steps(folder: Path, *, trains_experts: bool) -> int:
    """Learning steps that a run took, by its folder, those of the experts among them."""
    steps = int(pl.read_parquet(folder / "seeds.parquet")["env_steps"].sum())
    pool = stored_demonstrations.load(folder) if trains_experts else None
    return steps + (0 if pool is None else pool.metadata["expert_env_steps"])


def run(job: Sequence[str], cache: str, yardstick: str | None) -> dict[str, Any]:
    """Run the job in a process of its own; its seconds, in all and by phase, rates and memory.

    Raises:
        UserError: with the end of what it wrote, if it fails; as `yardstick_rate`.
    """
    before = yardstick_rate(yardstick)
    with tempfile.TemporaryDirectory() as folder:
        answer, out = Path(folder) / "answer.json", Path(folder) / "out"
        began = time.perf_counter()
        done = subprocess.run(
            [sys.executable, "-c", _CHILD, str(answer), *job, "--out", str(out)],
            env={**os.environ, "JAX_COMPILATION_CACHE_DIR": cache},
            capture_output=True,
            text=True,
        )
        seconds = time.perf_counter() - began
        if done.returncode:
            raise UserError(f"--job: the run failed: {done.stderr[-500:]}")
        found = json.loads(answer.read_text())
        spent, peak = found["phases"], found["peak_memory_bytes"]
        steps = learning_steps(out, trains_experts=run_grid.parse(job).demos is None)
    spent["rest"] = seconds - sum(spent.values())
    result = {
        "seconds": seconds,
        "learning_steps": steps,
        "phases": spent,
        "peak_memory_bytes": peak,
        "training_steps_per_second": steps / spent["training"],
    }
    if before is not None:
        rates = [before, yardstick_rate(yardstick)]
        result["yardstick_steps_per_second"] = rates
        result["seconds_by_yardstick"] = seconds * statistics.mean(rates) / steps
    return result


def work() -> None:
    """Be the job's process: `run_grid` with the command line's arguments after the first.

    The first is the file for its seconds by phase and its memory.
    """
    answer, *job = sys.argv[1:]
    with phases.counted() as spent, compile_cache.counted() as cost:
        code = run_grid.main(job)
    seconds = {**spent, "compilation": cost.seconds}
    measured = {"phases": seconds, "peak_memory_bytes": serving.peak_memory()}
    measuring.write(measured, Path(answer))
    sys.exit(code)


def yardstick_rate(command: str | None) -> float | None:
    """The yardstick's steps per second on one core; None without one.

    Raises:
        UserError: if it cannot be run, or prints no rate.
    """
    if command is None:
        return None
    printed = ""
    with contextlib.suppress(OSError):
        pinned = serving.pinned(shlex.split(command), measuring.one_core())
        printed = subprocess.run(pinned, capture_output=True, text=True).stdout
    rates = re.findall(r"([\d.]+) steps/s", printed)
    if not rates:
        raise UserError(f"--yardstick: {command} prints no steps/s; give a command that does")
    return float(rates[-1])


def table(runs: dict[str, list[dict[str, Any]]]) -> Table:
    """Medians over the rounds: a row for each phase, the rest, all of it, rates and memory."""
    shown = Table(box=box.SIMPLE, title="the main job, seconds")
    shown.add_column("phase")
    for kind in runs:
        shown.add_column(kind, justify="right")

    def row(name: str, form: str, of_run: Callable[[dict[str, Any]], float]) -> None:
        medians = (statistics.median(map(of_run, measured)) for measured in runs.values())
        shown.add_row(name, *(form.format(median) for median in medians))

    first = runs["cold"][0]
    for name in first["phases"]:
        row(name, "{:.1f}", lambda run, name=name: run["phases"].get(name, 0.0))
    row("all", "{:.1f}", lambda run: run["seconds"])
    row("learning steps/s while training", "{:,.0f}", lambda run: run["training_steps_per_second"])
    if first["peak_memory_bytes"] is not None:
        row("peak memory, MB", "{:,.0f}", lambda run: run["peak_memory_bytes"] / 1e6)
    if "seconds_by_yardstick" in first:
        row("T R / N", "{:.2f}", lambda run: run["seconds_by_yardstick"])
    return shown


if __name__ == "__main__":
    sys.exit(main())
