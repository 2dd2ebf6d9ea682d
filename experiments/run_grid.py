"""`python -m experiments.run_grid`: train the study, print its summary, draw its figures."""

import argparse
import sys
from collections.abc import Sequence
from typing import Any

import polars as pl
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from cmedirl_jax.envs import Env
from cmedirl_jax.runs import run as run_lib
from cmedirl_jax.runs import start, validation
from cmedirl_jax.runs.cluster import processes
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import compile_cache, ending, screen, signals, streams
from cmedirl_jax.runs.errors import Interrupted, UserError
from cmedirl_jax.runs.storage import plain
from cmedirl_jax.runs.validation import Plan
from cmedirl_jax.training import tasks
from experiments import presets

_STOPPING = "Stopping after this chunk of steps; once more to stop at once\n"
_CONTINUE = "start the same command again to go on"
_OF_A_PROCESS = ("out", "coordinator", "process_id")
"""The options in which the processes of one run may differ."""


@ending.in_a_line("run_grid")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    config = parse(arguments)
    fewer_will_do = _read_first(arguments).n_demos is None
    processes.check(config.cluster)
    if not config.cluster.several:
        return work(config, fewer_will_do)
    if not processes.is_worker():
        return processes.supervise("experiments.run_grid", arguments)
    return processes.guarded("run_grid", lambda: work(config, fewer_will_do))


def work(config: StudyConfig, fewer_will_do: bool) -> int:
    """Do the run, or this process's share of it; returns the exit code.

    Args:
        config: what the command line says.
        fewer_will_do: whether it leaves the number of demonstrations to the file's.
    """
    console = screen.console()
    compile_cache.use_cache()
    same = {k: v for k, v in plain.plain(config).items() if k not in _OF_A_PROCESS}
    try:
        cluster, devices = start.start(config.cluster, config.devices, config.seeds, same)
        console.quiet = not cluster.writer
        with signals.noted(None if console.quiet else _STOPPING, cluster) as interruption:
            plan = validation.plan(config, cluster, fewer_will_do=fewer_will_do)
            if config.env != presets.CAR and tasks.found(config.env) is None:
                said = f"{config.env} has no settings of its own: the car's, see docs/tasks.md"
                screen.say(console, said)
            if plan.subset_size < max(config.n_demos):
                held = f"holds {plan.subset_size} demonstrations, and each learner has them all"
                screen.say(console, f"{config.demos} {held}")
            # Matplotlib and scipy take a second to import: a refusal does not wait for them.
            from experiments import report

            concluded = run_lib.run(plan, devices, console, interruption, report.report, cluster)
    except UserError as error:
        return _end(2, str(error))
    except Interrupted as error:
        return _end(error.exit_code, f"stopped by {error}; {_CONTINUE}")
    except KeyboardInterrupt:
        return _end(130, f"stopped at once; {_CONTINUE}")
    except OSError as error:
        return _end(1, f"{error}; what is finished is kept: {_CONTINUE}")
    if concluded is not None:
        _print(console, concluded.summary, plan)
        for line in concluded.wrong:
            streams.complain(f"run_grid: {line}; the results stand, and {_CONTINUE}")
    return 0


def _print(console: Console, summary: pl.DataFrame, plan: Plan) -> None:
    screen.show(console, summary_table(summary))
    difference = summary["gymnasium_difference_max"].max()
    if difference is None and isinstance(plan.env, Env):
        console.print("No episode was repeated in Gymnasium's own copy of the task: it has none")
    if difference is not None:
        console.print(f"Largest difference to the same episodes in Gymnasium: {difference:.1g}")
    if summary["diverged"].sum():
        console.print(f"Seeds that diverged and were stopped: {summary['diverged'].sum()}")
    screen.say(console, f"Tables and figures: {plan.folder}")


def _end(exit_code: int, line: str) -> int:
    streams.complain(f"run_grid: {line}")
    return exit_code


def parse(arguments: Sequence[str]) -> StudyConfig:
    """The configuration: the preset's, with whatever else the command line says."""
    first = _read_first(arguments)
    return tyro.cli(
        StudyConfig,
        prog="python -m experiments.run_grid",
        description=__doc__,
        default=presets.preset(first.preset, first.grid, first.env),
        args=list(arguments),
    )


def _read_first(arguments: Sequence[str]) -> argparse.Namespace:
    # These decide every other default, which tyro needs; it reports a wrong one.
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False)
    parser.add_argument("--preset", default="tuned")
    parser.add_argument("--grid", default="main")
    parser.add_argument("--env", default=presets.CAR)
    # A default number of demonstrations is no more than a file holds; a number given is meant.
    parser.add_argument("--n-demos", "--n_demos", nargs="*")
    return parser.parse_known_args(list(arguments))[0]


def summary_table(summary: pl.DataFrame) -> Table:
    """The summary as a paper would print it."""
    title = f"{summary['seeds'].max()} seeds per row; 95% intervals"
    if summary["experts"].max() == 1:
        title += ", of this one expert"
    table = Table(title=title, box=box.SIMPLE)
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
