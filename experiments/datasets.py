"""`python -m experiments.datasets`: Minari datasets of the car and the pendulum.

Three for each task. expert: the best of DDPG agents that were trained to the end. Other agents are
stopped when about half of them solve the task. medium: the one of these that is nearest to half way
from random actions to the expert. mixed: all of these in turn. The datasets go where Minari keeps
its own; those that are there stay. The table is made by loading them with Minari alone.
"""

import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, get_args

import polars as pl
from rich import box
from rich.table import Table

from cmedirl_jax.commands import cmedirl
from cmedirl_jax.commands.demonstrators import Quality
from cmedirl_jax.ranges import Size
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs


class Task(NamedTuple):
    """A task, and for how many environment steps its agents train.

    Attributes:
        env: its name.
        name: what its datasets' names begin with.
        steps: of the experts.
        medium_steps: of the others.
    """

    env: str
    name: str
    steps: int
    medium_steps: int


TASKS = (
    Task("MountainCarContinuous-v0", "classic-control/mountaincarcontinuous", 12_000, 3_500),
    Task("Pendulum-v1", "classic-control/pendulum", 10_000, 7_000),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """How many, and what the datasets say of who made them.

    Attributes:
        seeds: Agents of each task.
        episodes: Of each dataset.
        author: Who makes them.
        author_email: How to reach them.
        code_permalink: The code that makes them.
        out: Folder of the runs, and of the table datasets.csv.
    """

    seeds: Size = 32
    episodes: Size = 100
    author: str = "cmedirl_jax"
    author_email: str | None = None
    code_permalink: str | None = None
    out: Path = Path("results/datasets")


@ending.in_a_line("datasets")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "experiments.datasets", __doc__, arguments)
    outputs.check("out", options.out / "datasets.csv")
    try:
        import minari  # type: ignore[import-not-found]
    except ModuleNotFoundError as error:
        raise UserError(f"{error}; run: python -m pip install -e '.[minari]'") from error
    rows = []
    for task in TASKS:
        reference: list[str] = []
        for quality in get_args(Quality):
            name = f"{task.name}/{quality}-v0"
            new = name not in minari.list_local_datasets()
            for command in _commands(task, name, quality, options, reference) if new else ():
                if code := cmedirl.main(command):
                    return code
            dataset = minari.load_dataset(name, download=False)
            _check(dataset, name, options)
            # One expert is what all three are measured by.
            reference = ["--ref-max-score", str(dataset.storage.metadata["ref_max_score"])]
            rows.append(described(dataset))
    table = pl.DataFrame(rows)
    outputs.write(options.out / "datasets.csv", table.write_csv(float_precision=2).encode())
    screen.show(screen.console(), shown(table))
    return 0


def _commands(
    task: Task, name: str, quality: Quality, options: Options, reference: list[str]
) -> list[list[str]]:
    """What `cmedirl` is given: to train the agents, and to record a dataset of their policies."""
    steps, seed = (task.steps, 0) if quality == "expert" else (task.medium_steps, 1)
    run = str(options.out / f"{task.env}-seed-{seed}")
    train = ["train", "--env", task.env, "--method", "ddpg", "--max-steps", str(steps)]
    train += ["--seed", str(seed), "--seeds", str(options.seeds), "--out", run]
    record = ["demos", "record", name, "--run", run, "--quality", quality, *reference]
    for fact in ("author", "author_email", "code_permalink"):
        if (value := getattr(options, fact)) is not None:
            record += [f"--{fact.replace('_', '-')}", value]
    return [train, [*record, "--episodes", str(options.episodes)]]


def _check(dataset: Any, name: str, options: Options) -> None:
    """Refuse a dataset of that name which this command would not have made."""
    if dataset.total_episodes != options.episodes:
        raise UserError(f"--episodes: {name} is there and has {dataset.total_episodes}")
    if "ref_max_score" not in dataset.storage.metadata:
        raise UserError(f"{name} is there and has no reference scores")


def described(dataset: Any) -> dict[str, Any]:
    """A row on a dataset of Minari's, from nothing but itself."""
    returns = pl.Series([float(sum(each.rewards)) for each in dataset.iterate_episodes()])
    known = dataset.storage.metadata
    worst, best = known["ref_min_score"], known["ref_max_score"]
    return {
        "dataset": dataset.spec.dataset_id,
        "episodes": int(dataset.total_episodes),
        "steps": int(dataset.total_steps),
        "return_mean": returns.mean(),
        "return_std": returns.std(ddof=0),
        "return_min": returns.min(),
        "return_max": returns.max(),
        "ref_min_score": worst,
        "ref_max_score": best,
        "score": (returns.mean() - worst) / (best - worst),
        "megabytes": known["dataset_size"],
    }


def shown(table: pl.DataFrame) -> Table:
    """The table as a terminal shows it."""
    printed = Table(box=box.SIMPLE)
    for name in table.columns:
        printed.add_column(name.replace("_", "\n"))
    for row in table.iter_rows():
        printed.add_row(*(f"{x:.2f}" if isinstance(x, float) else str(x) for x in row))
    return printed


if __name__ == "__main__":
    sys.exit(main())
