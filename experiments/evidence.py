"""Comparisons of cells over pooled runs, all of one page corrected together by Holm's method."""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import numpy as np

from cmedirl_jax.runs import paired
from cmedirl_jax.runs.paired import Difference
from cmedirl_jax.runs.report.summary import cell_label
from experiments import pooled
from experiments.measures import STEPS, Measure, speed
from experiments.pooled import CellName, Pooled

Outcome = Literal["yes", "no", "unclear"]
Sign = Literal["less", "more"]

LEVEL = 0.05


class Comparison(NamedTuple):
    """One test of the page.

    Attributes:
        label: what is compared.
        measure: by what.
        found: over all study seeds.
        studies: in each study seed.
        diverged: the largest share of the seeds of a cell that diverged.
        p_holm: adjusted over the page.
    """

    label: str
    measure: Measure
    found: Difference
    studies: tuple[Difference, ...]
    diverged: float = 0.0
    p_holm: float = 1.0

    @property
    def disagree(self) -> bool:
        """Two study seeds have effects of opposite sign, each significant by itself."""
        signs = {np.sign(one.mean.estimate) for one in self.studies if one.p_value <= LEVEL}
        return {-1.0, 1.0} <= signs

    @property
    def equivalent(self) -> bool:
        """The difference is shown to be as good as none."""
        return paired.equivalence(self.found, self.measure.margin) == "equivalent"

    def differs(self, sign: Sign) -> Outcome:
        """Whether the cell has less, or more, than the one that it is compared with."""
        # A cell most of whose seeds diverged says that something is wrong with it.
        if self.disagree or self.diverged > 0.5:
            return "unclear"
        if self.p_holm <= LEVEL:
            return "yes" if (self.found.mean.estimate > 0) == (sign == "more") else "no"
        return "no" if self.equivalent else "unclear"

    def no_better(self, better: Sign) -> Outcome:
        """Whether it is as good at most, where `better` is the better side."""
        opposite: dict[Outcome, Outcome] = {"yes": "no", "no": "yes", "unclear": "unclear"}
        return opposite[self.differs(better)]

    def __str__(self) -> str:
        mean, low, high = (self.measure.form.format(value) for value in self.found.mean)
        text = (
            f"{self.label}, {self.measure.name}: {mean} [{low}, {high}], p {self.p_holm:.4f}, "
            f"n = {self.found.pairs}"
        )
        if len(self.studies) > 1:
            each = ", ".join(self.measure.form.format(x.mean.estimate) for x in self.studies)
            text += f"; by study seed {each}"
        text += " (they disagree)" if self.disagree else ""
        return text + (f"; up to {self.diverged:.0%} of a cell diverged" if self.diverged else "")


class Evidence:
    """The runs, and the comparisons that were made of them."""

    def __init__(self, runs: Sequence[Pooled]):
        self._runs = runs
        self._made: dict[tuple[str, str], Comparison] = {}

    def adjust(self) -> None:
        """Correct the p-values of all comparisons made so far, by Holm's method."""
        if self._made:
            adjusted = paired.holm(np.array([one.found.p_value for one in self._made.values()]))
            for (key, one), p_value in zip(self._made.items(), adjusted, strict=True):
                self._made[key] = one._replace(p_holm=float(p_value))

    def run_with(self, *names: CellName, by_episodes: bool = False) -> Pooled | None:
        """The run that has all these cells, of the kind that is asked for where there is one.

        Of several it is the one with the most seeds, then the longest.
        """

        def preference(run: Pooled) -> tuple[bool, int, int]:
            seeds = min(run.cells[name].pair.size for name in names)
            return (run.episodes is None) != by_episodes, seeds, run.steps

        having = [run for run in self._runs if all(name in run.cells for name in names)]
        return max(having, key=preference, default=None)

    def largest(self, method: str) -> CellName:
        """A method's cell with the most demonstrations."""
        return method, max(self.numbers(method), default=0)

    def matched(self, method: str, other: str) -> tuple[CellName, CellName] | None:
        """Cells of two methods in one run with the most demonstrations that both have.

        A cell without demonstrations goes with any number. None if no run has both.
        """
        pairs = [
            ((method, n), (other, m))
            for run in self._runs
            for name, n in run.cells
            for other_name, m in run.cells
            if (name, other_name) == (method, other) and (n == m or 0 in (n, m))
        ]
        return max(pairs, key=lambda pair: (pair[0][1], pair[1][1]), default=None)

    def numbers(self, method: str) -> list[int]:
        """The numbers of demonstrations with which there is a cell of this method, in order."""
        return sorted({n for run in self._runs for name, n in run.cells if name == method})

    def compare_methods(self, method: str, other: str, measure: Measure) -> Comparison | None:
        """The `matched` cells of two methods compared; None if there are none."""
        pair = self.matched(method, other)
        return None if pair is None else self.compare(*pair, measure)

    def compare(self, name: CellName, other: CellName, measure: Measure) -> Comparison | None:
        """A cell against another of the same run; None if no run has both.

        `STEPS` are episodes in a run in which every seed lives as many of these.
        """
        run = self.run_with(name, other)
        if run is None or not pooled.aligned(run.cells[name], run.cells[other])[0].size:
            return None
        measure = speed(run) if measure is STEPS else measure

        def make() -> Comparison:
            cell, reference = run.cells[name], run.cells[other]
            mine, others = pooled.aligned(cell, reference)
            values = measure.of(cell, run)[mine]
            against = measure.of(reference, run)[others]
            clusters = pooled.clusters(cell, reference, mine, others)
            label = f"{cell_label(*name)} against {cell_label(*other)}"
            study = cell.study[mine]
            found = _comparison(label, measure, values, against, clusters, study, measure.span(run))
            diverged = max(cell.diverged.mean(), reference.diverged.mean())
            return found._replace(diverged=float(diverged))

        return self._remember((f"{name} {other}", measure.name), make)

    def above_expert(self, name: CellName, measure: Measure) -> Comparison | None:
        """A cell's returns against those of its seeds' experts, on the same starts."""
        run = self.run_with(name)
        if run is None or not np.isfinite(run.cells[name].expert_return).all():
            return None

        def make() -> Comparison:
            cell = run.cells[name]
            clusters = cell.expert if (cell.expert >= 0).all() else None
            values = measure.of(cell, run)
            label = f"{cell_label(*name)} against its experts"
            found = _comparison(
                label, measure, values, cell.expert_return, clusters, cell.study, measure.span(run)
            )
            return found._replace(diverged=float(cell.diverged.mean()))

        return self._remember((str(name), f"expert {measure.name}"), make)

    def _remember(self, key: tuple[str, str], make: Callable[[], Comparison]) -> Comparison:
        if key not in self._made:
            self._made[key] = make()
        return self._made[key]


def _comparison(
    label: str,
    measure: Measure,
    values: np.ndarray,
    against: np.ndarray,
    clusters: np.ndarray | None,
    study: np.ndarray,
    span: float,
) -> Comparison:
    def among(chosen: np.ndarray) -> Difference:
        own = None if clusters is None else clusters[chosen]
        return paired.compare(values[chosen], against[chosen], own, span=span)

    studies = tuple(among(study == one) for one in np.unique(study))
    return Comparison(label, measure, among(np.ones(values.size, bool)), studies)
