"""`python -m experiments.claims FOLDER ...`: a verdict on each claim of the paper.

The rules were written down before the study seeds 1 and 2 were trained. They say what each claim
would look like in the tables:

- near: the 95% interval of return minus the expert's, on the same starts, lies above -5.
- converged: the first evaluation with a mean return at the threshold.
- about n episodes: the interval of the median lies within a factor of 1.5 of n.
- faster, better, exceeds, more stable: the mean difference of pairs has that sign, and a p-value of
  at most 0.05 after Holm's correction over all tests of the page.
- no better, as stable: the 90% interval of the difference lies within the margin (500 environment
  steps or 5 episodes, 1 of return, 0.02 of the share of seeds), or the difference has the other
  sign. A significant difference comes first: it counts however small it is.

Speed is counted in environment steps where all seeds live as many of these, and in episodes where
they live as many episodes.

What neither shows is inconclusive. So is a difference that has opposite signs, each significant by
itself, in two study seeds, and one to or from a cell most of whose seeds diverged. Study seeds are
pooled; seeds that share an expert are resampled together. A claim of several parts is supported if
all are, not supported if none is, supported in part if some are and some are not, and inconclusive
otherwise.
"""

import dataclasses
import html
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import tyro

from cmedirl_jax.envs import split_id
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report.base import Run, Verdicts
from cmedirl_jax.runs.storage import outputs
from experiments import pooled, presets, verdicts
from experiments.pooled import Pooled
from experiments.verdicts import Claim


@dataclasses.dataclass(frozen=True)
class Options:
    """Which runs.

    Attributes:
        folders: Folders of runs of one configuration; they may differ in the study's seed, the
            cells and the budget. Claims about episodes are read off runs with --max-episodes where
            there are any.
        out: A file for the verdicts; default they are printed.
    """

    folders: Annotated[tuple[Path, ...], tyro.conf.Positional]
    out: Path | None = None


@ending.in_a_line("claims")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "experiments.claims", __doc__, arguments)
    outputs.check("out", options.out)
    if not options.folders:
        raise UserError("FOLDERS: give the folder of a run")
    text = of_folders(options.folders)
    if options.out is None:
        screen.say(screen.console(), text)
    else:
        outputs.write(options.out, text.encode())
    return 0


def of_folders(folders: Sequence[Path]) -> str:
    """The page of verdicts.

    Raises:
        UserError: as `pooled.load` and `of_one_page`, and for a run of a task other than the
            paper's.
    """
    loaded = [pooled.load(folder) for folder in folders]
    for run in loaded:
        if not _of_the_paper(run):
            env = run.config["env"]
            raise UserError(f"{run.folder}: {env}; the paper's claims are about {presets.CAR}")
    runs = of_one_page(loaded)
    return page(runs, verdicts.judge(runs))


def of_one_page(runs: Sequence[Run]) -> list[Pooled]:
    """The runs, pooled as far as they have one budget.

    Raises:
        UserError: as `pooled.pool`, if more than the budget differs, or for a single seed.
    """
    kinds: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        pooled.check_alike(runs[0], run, but=pooled.BUDGET)
        if run.config["seeds"] < 2:
            raise UserError(f"{run.folder}: one seed has no interval")
        kind = tuple(run.config.get(name) for name in pooled.BUDGET)
        kinds.setdefault(kind, []).append(run)
    return [pooled.pool(alike) for alike in kinds.values()]


def page(runs: Sequence[Pooled], claims: Sequence[Claim]) -> str:
    """The verdicts as Markdown."""
    config = runs[0].config
    lines = [f"# The paper's claims, under `{config['preset']}`", "", "From these runs:", ""]
    for run in runs:
        budget = f"{run.steps:,} steps" if run.episodes is None else f"{run.episodes} episodes"
        studies = sorted({int(study) for cell in run.cells.values() for study in cell.study})
        cells = ", ".join(f"{method} {n}" if n else method for method, n in run.cells)
        lines.append(
            f"- {run.config['seeds']} seeds x {budget}, study seeds "
            f"{', '.join(map(str, studies))}, experts: {run.config['expert']}; {cells}"
        )
    lines += ["", "| | claim | verdict |", "| --- | --- | --- |"]
    lines += [f"| {claim.name} | {claim.text} | **{claim.verdict}** |" for claim in claims]
    lines += ["", "What was measured. Brackets are 95% intervals; p is Holm's.", ""]
    for claim in claims:
        lines += [f"## {claim.name}: {claim.verdict}", "", f"{claim.text}.", ""]
        lines += [f"- {part.outcome}: {part.measured}" for part in claim.parts]
        lines += [] if claim.parts else [f"- {claim.why}"]
        lines.append("")
    return "\n".join(lines)


def verdicts_on(run: Run) -> Verdicts | None:
    """The verdicts on one run, for its report; None for a task that the claims are not about."""
    if not _of_the_paper(run):
        return None
    runs = of_one_page([run])
    judged = verdicts.judge(runs)
    return Verdicts(page(runs, judged), section(judged))


def _of_the_paper(run: Run) -> bool:
    """Whether its task is the paper's, in JAX or through Gymnasium."""
    return split_id(run.config["env"])[1] == presets.CAR


def section(claims: Sequence[Claim]) -> str:
    """The verdicts as HTML."""
    rows = []
    for claim in claims:
        kind = {"supported": "supported", "not supported": "not"}.get(claim.verdict, "other")
        measured = [f"{part.outcome}: {part.measured}" for part in claim.parts] or [claim.why]
        items = "".join(f"<li>{html.escape(line)}</li>" for line in measured)
        rows.append(
            f"<tr><td>{claim.name}</td><td>{html.escape(claim.text)}<details><summary>what was "
            f'measured</summary><ul>{items}</ul></details></td><td class="{kind}"><b>'
            f"{html.escape(claim.verdict)}</b></td></tr>"
        )
    return (
        "<h2>The paper's claims</h2><table><tr><th></th><th>claim</th><th>verdict</th></tr>"
        f"{''.join(rows)}</table>"
    )


if __name__ == "__main__":
    sys.exit(main())
