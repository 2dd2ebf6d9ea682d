"""`python -m benchmarks.coverage`: how often intervals and tests are right where truth is known.

Each row draws many samples of seeds from a law, and counts how often the 95% interval covers the
true number, or how often a test at 5% rejects a true null. Alternatives that are not used stand
beside them, to show that a row can fail.
"""

import dataclasses
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import polars as pl
import scipy.stats
from rich import box
from rich.table import Table

from cmedirl_jax.ranges import Size
from cmedirl_jax.runs import intervals, paired
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.intervals import Interval
from cmedirl_jax.runs.storage import outputs

EXPERTS = 16


@dataclasses.dataclass(frozen=True)
class Options:
    """How many samples, and where to write the table.

    Attributes:
        trials: Samples of each row.
        out: A CSV file for the table.
    """

    trials: Size = 1_000
    out: Path | None = None


class Row(NamedTuple):
    """A claim to check.

    Attributes:
        what: the interval or the test.
        law: what a seed's number is drawn from.
        seeds: in each sample.
        nominal: the rate that is promised.
        right: `sample's generator -> ` whether this sample counts; None where nothing is claimed.
        used: by this project; else it is there for comparison.
    """

    what: str
    law: str
    seeds: int
    nominal: float
    right: Callable[[np.random.Generator], bool | None]
    used: bool = True


@ending.in_a_line("coverage")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "benchmarks.coverage", __doc__, arguments)
    outputs.check("out", options.out)
    table = pl.DataFrame([measured(row, options.trials) for row in rows()])
    screen.show(screen.console(), shown(table))
    if options.out is not None:
        outputs.write(options.out, table.write_csv().encode())
    return 0


def measured(row: Row, trials: int) -> dict[str, object]:
    """A row of the table: the rate over the samples in which something is claimed."""
    found = [row.right(np.random.default_rng([trial, row.seeds])) for trial in range(trials)]
    claimed = [one for one in found if one is not None]
    return {
        "what": row.what,
        "law": row.law,
        "seeds": row.seeds,
        "used": row.used,
        "nominal": row.nominal,
        "measured": float(np.mean(claimed)) if claimed else None,
        "samples": len(claimed),
    }


def shown(table: pl.DataFrame) -> Table:
    """The table for the screen."""
    printed = Table(title="rates over samples with a known truth", box=box.SIMPLE)
    for name in table.columns:
        printed.add_column(name)
    for row in table.iter_rows():
        printed.add_row(*(f"{x:.3f}" if isinstance(x, float) else str(x) for x in row))
    return printed


def rows() -> list[Row]:
    """All rows."""
    return [
        *_shares(),
        *_means(),
        *_clusters(),
        *_tests(),
        *_equivalences(),
    ]


def _covers(interval: Interval, truth: float) -> bool | None:
    if np.isnan(interval.low):
        return None
    return interval.low <= truth <= interval.high


def _rare(rng: np.random.Generator, seeds: int, share: float) -> np.ndarray:
    """A dip fraction that `share` of the seeds have at all, on average a tenth there."""
    return (rng.random(seeds) < share) * rng.uniform(0.0, 0.2, seeds)


def _shares() -> list[Row]:
    found = []
    for seeds in (32, 100):
        for share in (0.03, 0.11):
            law = f"{share:.0%} of seeds dip"
            found += [
                Row(
                    "share, Clopper-Pearson",
                    law,
                    seeds,
                    0.95,
                    lambda rng, n=seeds, p=share: _covers(intervals.share(rng.random(n) < p), p),
                ),
                Row(
                    "mean dip fraction, where ten seeds dip",
                    law,
                    seeds,
                    0.95,
                    lambda rng, n=seeds, p=share: _covers(
                        intervals.rate(_rare(rng, n, p)), 0.1 * p
                    ),
                ),
                Row(
                    "mean dip fraction, bootstrap of any number",
                    law,
                    seeds,
                    0.95,
                    lambda rng, n=seeds, p=share: _covers(
                        intervals.mean(_rare(rng, n, p)), 0.1 * p
                    ),
                    used=False,
                ),
            ]
    return found


def _means() -> list[Row]:
    # The mean of the middle half of an exponential law: its integral between the quartiles.
    middle = scipy.stats.expon.expect(
        lambda x: x, lb=scipy.stats.expon.ppf(0.25), ub=scipy.stats.expon.ppf(0.75)
    )
    statistics = (
        ("median, order statistics", intervals.median, np.log(2.0)),
        ("mean, percentile bootstrap", intervals.mean, 1.0),
        ("interquartile mean", intervals.interquartile_mean, 2.0 * float(middle)),
    )
    return [
        Row(
            name,
            "exponential",
            seeds,
            0.95,
            lambda rng, n=seeds, of=of, truth=truth: _covers(of(rng.exponential(size=n)), truth),
        )
        for name, of, truth in statistics
        for seeds in (32, 100)
    ]


def _shared(rng: np.random.Generator, seeds: int) -> tuple[np.ndarray, np.ndarray]:
    """Numbers half of whose variance lies between experts, and who shares one."""
    experts = np.arange(seeds) % EXPERTS
    return rng.normal(size=EXPERTS)[experts] + rng.normal(size=seeds), experts


def _clusters() -> list[Row]:
    law = f"normal, {EXPERTS} experts carry half of the variance"

    def resampled(rng: np.random.Generator) -> bool | None:
        values, experts = _shared(rng, 96)
        return _covers(intervals.mean(values, clusters=experts), 0.0)

    def blind(rng: np.random.Generator) -> bool | None:
        return _covers(intervals.mean(_shared(rng, 96)[0]), 0.0)

    def flipped(rng: np.random.Generator) -> bool:
        return paired.p_value(*_shared(rng, 96)) <= 0.05

    def flipped_blindly(rng: np.random.Generator) -> bool:
        return paired.p_value(_shared(rng, 96)[0], None) <= 0.05

    return [
        Row("mean, experts resampled", law, 96, 0.95, resampled),
        Row("mean, seeds resampled", law, 96, 0.95, blind, used=False),
        Row("sign flips of experts reject", law, 96, 0.05, flipped),
        Row("sign flips of seeds reject", law, 96, 0.05, flipped_blindly, used=False),
    ]


def _flips_of_means(difference: np.ndarray) -> float:
    """Sign flips that are not studentised."""
    signs = np.random.default_rng(0).choice([-1.0, 1.0], size=(999, difference.size))
    extreme = np.abs((signs * difference).mean(axis=1)) >= abs(difference.mean())
    return (1 + extreme.sum()) / 1_000


def _tests() -> list[Row]:
    laws: tuple[tuple[str, Callable[[np.random.Generator, int], np.ndarray]], ...] = (
        ("normal difference", lambda rng, n: rng.normal(size=n)),
        ("exponential minus constant", lambda rng, n: rng.exponential(size=n) - 1.0),
    )
    found = []
    for law, draw in laws:
        for seeds in (32, 100):
            found += [
                Row(
                    "studentised sign flips reject",
                    law,
                    seeds,
                    0.05,
                    lambda rng, n=seeds, of=draw: paired.p_value(of(rng, n), None) <= 0.05,
                ),
                Row(
                    "sign flips of bare means reject",
                    law,
                    seeds,
                    0.05,
                    lambda rng, n=seeds, of=draw: _flips_of_means(of(rng, n)) <= 0.05,
                    used=False,
                ),
            ]

    def any_of_ten(rng: np.random.Generator) -> bool:
        p_values = [paired.p_value(rng.normal(size=32), None) for _ in range(10)]
        return bool((paired.holm(np.array(p_values)) <= 0.05).any())

    def logrank(rng: np.random.Generator) -> bool:
        return intervals.logrank(*np.ceil(rng.exponential(3.0, (2, 100)))) <= 0.05

    return [
        *found,
        Row("Holm rejects any of ten tests", "normal difference", 32, 0.05, any_of_ten),
        Row("log-rank rejects", "exponential, unpaired", 100, 0.05, logrank),
    ]


def _equivalences() -> list[Row]:
    def normal(rng: np.random.Generator) -> bool:
        found = paired.compare(rng.normal(1.0, 1.0, 100), np.zeros(100))
        return paired.equivalence(found, 1.0) == "equivalent"

    def shares(rng: np.random.Generator) -> bool:
        found = paired.compare((rng.random(150) < 0.02) * 1.0, np.zeros(150), span=1.0)
        return paired.equivalence(found, 0.02) == "equivalent"

    def bootstrapped(rng: np.random.Generator) -> bool:
        differs = (rng.random(150) < 0.02) * 1.0
        return intervals.mean(differs, confidence=0.9).within(-0.02, 0.02)

    rare = "a pair in fifty differs, all to one side"
    return [
        Row("equivalence claimed on the margin", "normal difference", 100, 0.05, normal),
        Row("equivalence claimed on the margin", rare, 150, 0.05, shares),
        Row("equivalence by bootstrap alone", rare, 150, 0.05, bootstrapped, used=False),
    ]


if __name__ == "__main__":
    sys.exit(main())
