"""A run as a command: from its configuration to its printed summary and its exit code."""

from collections.abc import Callable
from pathlib import Path

from rich.console import Console

from cmedirl_jax.envs import Env
from cmedirl_jax.envs.registry import ENVS
from cmedirl_jax.runs import run as run_lib
from cmedirl_jax.runs import start, validation
from cmedirl_jax.runs.cells import pools
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import compile_cache, screen, signals, streams, summary_table
from cmedirl_jax.runs.errors import Interrupted, UserError
from cmedirl_jax.runs.report.base import Report
from cmedirl_jax.runs.storage import plain
from cmedirl_jax.runs.validation import Plan
from cmedirl_jax.training import tasks

_STOPPING = "Stopping after this chunk of steps; once more to stop at once\n"
_CONTINUE = "start the same command again to go on"
_OF_A_PROCESS = ("out", "coordinator", "process_id")
"""The options in which the processes of one run may differ."""


def execute(
    program: str,
    config: StudyConfig,
    report: Callable[[Path], Report],
    *,
    fewer_will_do: bool,
) -> int:
    """Do a run, or this process's share of it; returns the exit code.

    Args:
        program: the command's name, which begins its complaints.
        config: what the command line says.
        report: writes the report of a run's folder.
        fewer_will_do: whether the command line leaves the number of demonstrations to the file's.
    """
    console = screen.console()
    compile_cache.use_cache()
    same = {k: v for k, v in plain.plain(config).items() if k not in _OF_A_PROCESS}

    def end(exit_code: int, line: str) -> int:
        streams.complain(f"{program}: {line}")
        return exit_code

    try:
        fewest = start.FEWEST if config.env in ENVS else start.FEWEST_ON_HOST
        cluster, devices = start.start(config.cluster, config.devices, config.seeds, same, fewest)
        console.quiet = not cluster.writer
        with signals.noted(None if console.quiet else _STOPPING, cluster) as interruption:
            plan = validation.plan(config, cluster, fewer_will_do=fewer_will_do)
            _say_what_was_assumed(console, config, plan, fewer_will_do)
            concluded = run_lib.run(plan, devices, console, interruption, report, cluster)
    except UserError as error:
        return end(2, str(error))
    except Interrupted as error:
        return end(error.exit_code, f"stopped by {error}; {_CONTINUE}")
    except KeyboardInterrupt:
        return end(130, f"stopped at once; {_CONTINUE}")
    except OSError as error:
        return end(1, f"{error}; what is finished is kept: {_CONTINUE}")
    if concluded is not None:
        _print(console, concluded, plan)
        for line in concluded.wrong:
            streams.complain(f"{program}: {line}; the results stand, and {_CONTINUE}")
    return 0


def _say_what_was_assumed(
    console: Console, config: StudyConfig, plan: Plan, n_demos_assumed: bool
) -> None:
    if tasks.found(config.env) is None:
        said = f"{config.env} has no settings of its own: the car's, see docs/tuning.md"
        screen.say(console, said)
    if n_demos_assumed and plan.demos is not None and any(n_demos for _, n_demos in plan.asked):
        held, drawn = pools.held(plan.demos), plan.subset_size
        share = f"all {held}" if drawn == held else f"{drawn} of {held}"
        screen.say(console, f"{config.demos}: each learner has {share} demonstrations")


def _print(console: Console, concluded: Report, plan: Plan) -> None:
    screen.show(console, summary_table.of(concluded.summary))
    difference = concluded.summary["gymnasium_difference_max"].max()
    if difference is None and isinstance(plan.env, Env):
        console.print("No episode was repeated in Gymnasium's own copy of the task: it has none")
    if difference is not None:
        console.print(f"Largest difference to the same episodes in Gymnasium: {difference:.1g}")
    if diverged := concluded.summary["diverged"].sum():
        console.print(f"Seeds that diverged and were stopped: {diverged}")
    screen.say(console, f"Tables and figures: {plan.folder}")
