"""`python -m experiments.variants`: one change of the settings at a time, against what it changes.

Each variant is a run of `run_grid` with the same demonstrations and seeds as its base, so that they
are compared seed by seed; p-values are Holm's over the whole table. The deviation of r_D over the
replay stands beside every row: a variant with a smaller reward is not a worse one.

With `--demos POOL` alone the changes are the study's. `--base` and `--changes` make others, of any
task: --base="--env Pendulum-v1 --methods me-ddpg" --changes reward.bound=0.1 reward.bound=1.
"""

import dataclasses
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import polars as pl
from rich import box
from rich.table import Table

from cmedirl_jax.ranges import Size
from cmedirl_jax.runs import paired
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import outputs
from experiments import measures, pooled, run_grid
from experiments.measures import AREA, FINAL, STABLE, STEPS, Measure
from experiments.pooled import CellSeeds, Pooled

MEASURES = (STEPS, AREA, FINAL, STABLE)


class Variant(NamedTuple):
    """A run, and the one that it is a change of.

    Attributes:
        name: of its folder and its row.
        options: of `run_grid`.
        base: the name of another variant; empty for a base.
    """

    name: str
    options: str
    base: str = ""


def _of(base: str, method: str, options: dict[str, str]) -> list[Variant]:
    found = [Variant(base, f"--methods {method}")]
    for name, more in options.items():
        found.append(Variant(name, f"--methods {method} {more}", base))
    return found


VARIANTS = (
    *_of(
        "me-ddpg",
        "me-ddpg",
        {
            "transition": "--reward.objective transition",
            "transition-recorded": "--reward.objective transition "
            "--reward-batches.weights recorded --reward.weight-limit 3",
            "transition-fusion": "--reward.objective transition "
            "--reward-batches.weights fusion --reward.weight-limit 3",
            "trajectory": "--reward.objective trajectory",
            "trajectory-large": "--reward.objective trajectory --reward.bound 0.3",
            "zero-mean": "--reward.gauge zero-mean",
            "absorbing": "--reward.absorbing",
            "state": "--reward-network.inputs state",
            "potential": "--reward-schedule.shaping potential",
            "radial-basis": "--reward-network.kind radial-basis",
        },
    ),
    *_of("irl-only", "irl-only", {"irl-only-throughout": "--reward-schedule.stop None"}),
    *_of(
        "gail",
        "gail",
        {
            "gail-throughout": "--reward-schedule.stop None",
            "gail-log-d": "--gail.form 'log D'",
        },
    ),
    *_of(
        "hs-ddpg",
        "hs-ddpg",
        {
            "hs-softmax": "--hot-start.critic softmax",
            "hs-quadratic": "--hot-start.critic quadratic",
            "hs-large-margin": "--hot-start.critic large-margin",
            "hs-monte-carlo": "--hot-start.critic monte-carlo",
            "hs-no-cloning": "--schedule.cloning none",
        },
    ),
)


@dataclasses.dataclass(frozen=True)
class Options:
    """What is changed, whose demonstrations, how many seeds, and where the runs go.

    Attributes:
        base: Options of `run_grid`, among them one method, that all changes share: with an equals
            sign, --base="--env Pendulum-v1 --methods me-ddpg".
        changes: Options that one variant of the base has, each NAME=VALUE or, for a switch, NAME;
            several with commas: reward.bound=0.1 agent.discount=0.95,reward.absorbing. A value with
            a space has quotes of its own: "gail.form='log D'". Default: the study's.
        demos: A demonstrations file that all runs learn from, such as the pool of another run.
            Default, for changes of your own: those of the experts that the base's run trains.
        out: A folder; each variant has its run in a folder of its own there.
        only: Variants of the study to run, with their bases; default all.
        seeds: Learners of each run.
        csv: A CSV file for the table.
    """

    base: str = ""
    changes: tuple[str, ...] = ()
    demos: Path | None = None
    out: Path = Path("results/variants")
    only: tuple[str, ...] = ()
    seeds: Size = 32
    csv: Path | None = None


@ending.in_a_line("variants")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code, that of the first run that does not end well."""
    options = read(Options, "experiments.variants", __doc__, arguments)
    outputs.check("csv", options.csv)
    chosen = variants_of(options)
    check(chosen)
    pool = options.demos
    for variant in chosen:
        folder = options.out / variant.name
        demos = [] if pool is None else ["--demos", str(pool)]
        common = [*demos, "--seeds", str(options.seeds), "--out", str(folder)]
        code = run_grid.main([*shlex.split(variant.options), *common])
        if code:
            return code
        kept = folder / stored_demonstrations.FOLDER / stored_demonstrations.FILE
        pool = kept if pool is None and kept.exists() else pool
    table = compare(options.out, chosen)
    screen.show(screen.console(), shown(table))
    if options.csv is not None:
        outputs.write(options.csv, table.write_csv().encode())
    return 0


def variants_of(options: Options) -> list[Variant]:
    """The variants that the options ask for, each after its base.

    Raises:
        UserError: for options that do not go together, as `chosen_of`.
    """
    if not options.changes and not options.base:
        if options.demos is None:
            raise UserError("--demos: the study's variants need the demonstrations of a run")
        return chosen_of(options.only)
    if not options.changes or not options.base or options.only:
        raise UserError("--base and --changes go together, and without --only")
    base = Variant("base", options.base)
    # A change named twice is run once.
    return [base, *(_changed(base, change) for change in dict.fromkeys(options.changes))]


def check(variants: Sequence[Variant]) -> None:
    """Refuse options that cannot be read, or that keep seeds from being compared, before any run.

    Raises:
        UserError: naming the variant.
    """
    pairing = {}
    for variant in variants:
        try:
            arguments = shlex.split(variant.options)
        except ValueError as error:
            raise UserError(f"{variant.name}: {error}") from error
        names = {argument.partition("=")[0] for argument in arguments}
        if ours := names & {"--demos", "--out", "--seeds"}:
            raise UserError(f"{variant.name}: give {ours.pop()} to this command, for all variants")
        config = run_grid.parse(arguments)
        if len(config.methods) * len(config.n_demos) != 1:
            raise UserError(f"{variant.name}: needs one method and one number of demonstrations")
        pairing[variant.name] = config.env, config.seed
        if variant.base and pairing[variant.name] != pairing[variant.base]:
            raise UserError(f"{variant.name}: needs the task and the study seed of its base")


def _changed(base: Variant, change: str) -> Variant:
    options = (f"--{' '.join(option.split('=', 1))}" for option in change.split(","))
    return Variant(change.replace("/", "-"), " ".join((base.options, *options)), base.name)


def chosen_of(names: Sequence[str]) -> list[Variant]:
    """These variants with their bases, or all.

    Raises:
        UserError: for an unknown name.
    """
    there = {variant.name: variant for variant in VARIANTS}
    for name in names:
        if name not in there:
            raise UserError(f"--only: there is no variant {name!r}; there are {', '.join(there)}")
    wanted = {*names, *(there[name].base for name in names)} if names else there
    return [variant for variant in VARIANTS if variant.name in wanted]


def compare(folder: Path, variants: Sequence[Variant]) -> pl.DataFrame:
    """A row for each variant: its summary, and its differences to its base, seed by seed."""
    rows, p_values = [], []
    for variant in variants:
        run = folder / variant.name
        summary = pl.read_csv(run / "summary.csv").row(0, named=True)
        row: dict[str, Any] = {
            "variant": variant.name,
            "base": variant.base or None,
            "options": variant.options,
            **summary,
        }
        if variant.base:
            pair = _cell(run), _cell(folder / variant.base)
            for measure in MEASURES:
                found = measures.difference(measure, *pair)
                p_values.append((len(rows), measure.name, found.pop("p_value")))
                row |= {f"{measure.name}_{name}": value for name, value in found.items()}
        rows.append(row)
    adjusted = paired.holm(np.array([p_value for *_, p_value in p_values]))
    for (index, name, _), p_value in zip(p_values, adjusted, strict=True):
        rows[index][f"{name}_p_holm"] = float(p_value)
    return pl.DataFrame(rows, infer_schema_length=None)


def _cell(folder: Path) -> tuple[CellSeeds, Pooled]:
    run = pooled.pool([pooled.load(folder)])
    (cell,) = run.cells.values()
    return cell, run


def shown(table: pl.DataFrame) -> Table:
    """The table for the screen."""
    printed = Table(title="differences to the base; 95% intervals, Holm's p", box=box.SIMPLE)
    for name in ("variant", "base", "r_D deviation", *(measure.name for measure in MEASURES)):
        printed.add_column(name.replace("_", " "))
    for row in table.iter_rows(named=True):
        spread = "-" if row["r_d_std"] is None else f"{row['r_d_std']:.3f}"
        cells = [_words(measure, row) if row["base"] else "" for measure in MEASURES]
        printed.add_row(row["variant"], row["base"] or "", spread, *cells)
    return printed


def _words(measure: Measure, row: dict[str, Any]) -> str:
    name, form = measure.name, measure.form.format
    mean, low, high = (form(row[f"{name}_difference{end}"]) for end in ("", "_low", "_high"))
    shows = f"p {row[f'{name}_p_holm']:.4f}, {row[f'{name}_equivalence']}"
    return f"{mean} \\[{low}, {high}]\n{shows}"


if __name__ == "__main__":
    sys.exit(main())
