"""`python -m experiments.run_grid`: train the grid, print the summary, draw the figures."""

import argparse
import contextlib
import os
import sys
from collections.abc import Sequence
from typing import Any

import jax
import polars as pl
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from cmedirl_jax.envs import Env
from cmedirl_jax.runs import heap
from cmedirl_jax.runs import run as run_lib
from cmedirl_jax.runs.cluster import exchange, processes
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import compile_cache, signals, streams
from cmedirl_jax.runs.console.signals import Interrupted
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.validation import Cell
from experiments.presets import PRESETS

_STOPPING = "Stopping after this chunk of steps; once more to stop at once\n"
_CONTINUE = "start the same command again to go on"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    try:
        return _main(sys.argv[1:] if arguments is None else arguments)
    finally:
        streams.flush()


def _main(arguments: Sequence[str]) -> int:
    config = parse(arguments)
    try:
        processes.check(config)
    except UserError as error:
        return _end(2, str(error))
    if not processes.is_asked(config):
        return work(config)
    if not processes.is_worker():
        return processes.supervise("experiments.run_grid", arguments)
    return processes.guarded("run_grid", lambda: work(config))


def work(config: StudyConfig) -> int:
    """Do the run, or this process's share of it; returns the exit code."""
    console = Console(file=streams.dispensable())
    if not console.is_terminal:
        console = Console(file=streams.dispensable(), width=120)
    heap.share(arenas=cores())
    compile_cache.use_cache()
    try:
        # Before anything else: the first array that JAX makes fixes the number of CPU devices.
        devices = start_devices(config)
        console.quiet = not exchange.is_writer()
        with signals.noted(None if console.quiet else _STOPPING) as interruption:
            summary = run_lib.run(config, devices, console, interruption, _conclude)
    except UserError as error:
        return _end(2, str(error))
    except Interrupted as error:
        return _end(error.exit_code, f"stopped by {error}; {_CONTINUE}")
    except KeyboardInterrupt:
        return _end(130, f"stopped at once; {_CONTINUE}")
    except OSError as error:
        return _end(1, f"{error}; what is finished is kept: {_CONTINUE}")
    if summary is None:
        return 0
    console.print(summary_table(summary))
    difference = summary["gymnasium_difference_max"].max()
    console.print(f"Largest difference to the same episodes in Gymnasium: {difference:.1g}")
    if summary["diverged"].sum():
        console.print(f"Seeds that diverged and were stopped: {summary['diverged'].sum()}")
    console.print(
        f"Tables and figures: {config.folder}", markup=False, highlight=False, soft_wrap=True
    )
    return 0


def _conclude(config: StudyConfig, env: Env, cells: list[Cell], redraw: bool) -> pl.DataFrame:
    # Matplotlib and scipy take a second to import: a refusal does not wait for them.
    from experiments import conclusion

    return conclusion.conclude(config, env, cells, redraw)


def _end(exit_code: int, line: str) -> int:
    streams.complain(f"run_grid: {line}")
    return exit_code


def parse(arguments: Sequence[str]) -> StudyConfig:
    """The configuration: the preset's, with whatever else the command line says."""
    # The preset decides every other default, so it is read first; tyro reports a wrong one.
    first = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    first.add_argument("--preset", default="tuned")
    preset, _ = first.parse_known_args(list(arguments))
    return tyro.cli(
        StudyConfig,
        prog="python -m experiments.run_grid",
        description=__doc__,
        default=PRESETS.get(preset.preset, PRESETS["tuned"]),
        args=list(arguments),
    )


def start_devices(config: StudyConfig) -> list[jax.Device]:
    """Start JAX with as many CPU devices as the run uses, or take the GPUs there are.

    Raises:
        UserError: if more devices are asked for than there are.
    """
    # A device wants a few seeds to itself: fewer than four a device do not fill a vector unit.
    wanted = config.devices or max(1, min(cores(), config.seeds // 4))
    if config.devices is None or 1 <= config.devices <= cores():
        # Once JAX has started (a second call in one process) it keeps the devices it has.
        with contextlib.suppress(RuntimeError):
            jax.config.update("jax_num_cpu_devices", wanted)
    if processes.is_asked(config):
        processes.join(config)
    devices = jax.local_devices()
    available = len(devices) if devices[0].platform != "cpu" else cores()
    refused = config.devices is not None and config.devices > available
    # Together: a process that left alone would keep the others waiting.
    if exchange.any_process(refused):
        there = f"there are {available}" if refused else "another process has fewer"
        raise UserError(f"--devices: {config.devices} asked, {there}")
    if processes.is_asked(config):
        exchange.check_same(config)
        shared = exchange.devices(config.devices, config.seeds)
        exchange.connect(shared)
        return shared
    return devices[: max(config.devices, 1)] if config.devices is not None else devices


def cores() -> int:
    """How many cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def summary_table(summary: pl.DataFrame) -> Table:
    """The summary as a paper would print it."""
    table = Table(title=f"{summary['seeds'].max()} seeds per row; 95% intervals", box=box.SIMPLE)
    table.add_column("method")
    table.add_column("N_T", justify="right")
    for name in (
        "converged",
        "steps until\nconverged",
        "dip fraction",
        "area",
        "final return",
        "best policy",
    ):
        table.add_column(name, justify="right")
    for row in summary.iter_rows(named=True):
        table.add_row(
            row["method"],
            str(row["n_demos"]) if row["n_demos"] else "-",
            _interval(row, "converged_fraction", "{:.2f}"),
            _interval(row, "convergence_env_step_median", "{:,.0f}"),
            _interval(row, "dip_fraction", "{:.3f}"),
            _interval(row, "area", "{:.1f}"),
            _spread(row, "final_return"),
            _spread(row, "best_return"),
        )
    return table


def _interval(row: dict[str, Any], name: str, form: str) -> str:
    value, low, high = (row[name + end] for end in ("", "_low", "_high"))
    if value is None:
        return "-"
    bounds = ("?" if bound is None else form.format(bound) for bound in (low, high))
    return f"{form.format(value)}\n\\[{', '.join(bounds)}]"


def _spread(row: dict[str, Any], name: str) -> str:
    mean, std = row[f"{name}_mean"], row[f"{name}_std"]
    return f"{mean:.2f}" if std is None else f"{mean:.2f}\n± {std:.2f}"


if __name__ == "__main__":
    sys.exit(main())
