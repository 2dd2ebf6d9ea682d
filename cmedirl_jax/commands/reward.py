"""Say whether the rewards that a run has learned are worth keeping, and carry one away.

Example: cmedirl reward results/tuned
With fresh agents on each reward: --retrain 12000 --physics power=0.0012 gravity=0.003
One learner's reward and policy as files: --export r_d --method hs-me-ddpg --seed 3

Distances and correlations need the task's own reward, in JAX; the rest is of demonstrations and
policies alone. RUN/reward/ gets report.html, tables with a row for each learner, and pictures.
"""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import polars as pl
from rich import box
from rich.console import Console
from rich.table import Table

from cmedirl_jax.commands import sources
from cmedirl_jax.ranges import Size
from cmedirl_jax.runs import carry, start
from cmedirl_jax.runs.cluster.base import ClusterOptions
from cmedirl_jax.runs.console import compile_cache, screen, streams
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report.base import Run
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import tables

if TYPE_CHECKING:
    from cmedirl_jax.runs.report.reward_report import RewardReport


@dataclasses.dataclass(frozen=True)
class Options(sources.PolicyOptions):
    """Which run; of its learners, the one whose reward is carried away.

    Attributes:
        retrain: Environment steps of fresh agents that learn from each reward alone, frozen.
        physics: Other parameters of the task to retrain under too, as power=0.0012 or
            start_low=-0.9,start_high=-0.7.
        export: A new folder for the learner's reward and policy, as files that other programs read.
        licence: Of the exported reward, for its card.
    """

    retrain: Size | None = None
    physics: tuple[str, ...] = ()
    export: Path | None = None
    licence: str = "none given"


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    folder, written = options.folder, run_folder.read(options.folder)
    config = written["config"]
    _check_together(options)
    chosen = None
    if options.export is not None:
        chosen = sources.learned(folder, options.method, options.seed, options.n_demos)
        carry.check(options.export, chosen)
    compile_cache.use_cache()
    # Agents are many enough for all cores; the first call of JAX says how many devices it has.
    agents = config["seeds"] if options.retrain else 1
    devices, plan = start.start(ClusterOptions(), None, agents, {})[1], None
    # scipy takes a second to import: a refusal does not wait for it.
    from cmedirl_jax.runs.report import retrained, reward_report, reward_samples

    console = screen.console()
    if options.retrain is not None:
        plan = retrained.plan(
            sources.task(config["env"]), options.retrain, options.physics, devices
        )
    with run_folder.held(folder):
        solved = run_folder.solved(folder, written)
        run = Run(folder, config, solved, tables.read(folder, config))
        rewarded = reward_samples.read(folder)
        if rewarded.diverged:
            screen.say(console, f"{rewarded.diverged} learners diverged and are left out")
        report = reward_report.write(
            run, rewarded, plan, lambda line: screen.say(console, line), streams.complain
        )
    _show(console, report)
    screen.say(console, f"Report: {folder / run_folder.REWARD / 'report.html'}")
    if options.export is not None and chosen is not None:
        words = {"licence": options.licence, "card": report.rows, "summary": report.summary}
        carry.save(options.export, folder, chosen, options.seed, **words)
        screen.say(console, f"Reward and policy: {options.export}")
    return 0


def _check_together(options: Options) -> None:
    """Refuse options that would do nothing.

    Raises:
        UserError: naming the first.
    """
    if options.physics and options.retrain is None:
        raise UserError("--physics: says under what to retrain; give --retrain too")
    for name in ("method", "seed", "n_demos", "licence"):
        default = Options.__dataclass_fields__[name].default
        if options.export is None and getattr(options, name) != default:
            raise UserError(f"--{name.replace('_', '-')}: says what to export; give --export too")


def _show(console: Console, report: "RewardReport") -> None:
    """Print the tables, and what their columns are."""
    from cmedirl_jax.runs.report import retrained, reward_cards, reward_diagnostics

    title = f"{report.summary['seeds'].max()} seeds per row; 95% intervals"
    _explained(console, report.summary, "measure", title, reward_cards.MEASURES)
    # Of fewer than four learners there is no correlation.
    if not report.correlations.is_empty():
        title = "rank correlation with the learners' return at the end; 95% intervals"
        shown = report.correlations.with_columns(mean=pl.col("rank_correlation"))
        _explained(console, shown, "diagnostic", title, reward_diagnostics.DIAGNOSTICS)
    if report.retraining is None:
        return
    for (physics,), rows in report.retraining.group_by("physics", maintain_order=True):
        title = f"fresh agents on each reward, {physics} physics"
        _explained(console, rows, "measure", title, retrained.MEASURES)
    if report.outdated is not None:
        screen.say(console, report.outdated)


def _explained(
    console: Console, rows: pl.DataFrame, by: str, title: str, words: Mapping[str, str]
) -> None:
    screen.show(console, _table(rows, by, title))
    for name in rows[by].unique(maintain_order=True):
        screen.say(console, f"{name}: {words[name]}")


def _table(rows: pl.DataFrame, by: str, title: str) -> Table:
    """A row for each cell, a column for each value of `by`."""
    printed = Table(title=title, box=box.SIMPLE)
    heads = rows[by].unique(maintain_order=True).to_list()
    for name in ("method", "N_T", *(head.replace("_", "\n") for head in heads)):
        printed.add_column(name, justify="left" if name == "method" else "right")
    for (method, n_demos), cell in rows.group_by("method", "n_demos", maintain_order=True):
        of_head = {row[by]: row for row in cell.iter_rows(named=True)}
        cells = [_interval(of_head[each]) if each in of_head else "-" for each in heads]
        printed.add_row(str(method), str(n_demos) if n_demos else "-", *cells)
    return printed


def _interval(row: dict[str, Any]) -> str:
    return f"{row['mean']:.2f}\n\\[{row['low']:.2f}, {row['high']:.2f}]"
