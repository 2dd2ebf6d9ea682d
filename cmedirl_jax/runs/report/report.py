"""Write a run's tables, summary, figures and page from its finished cells."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from cmedirl_jax.runs.lifetime import lifetime
from cmedirl_jax.runs.report import figures, page
from cmedirl_jax.runs.report.base import Report, Run, Verdicts
from cmedirl_jax.runs.report.summary import summarise
from cmedirl_jax.runs.storage import cells, outputs, tables
from cmedirl_jax.runs.storage import folder as run_folder


def write(
    folder: Path, redraw: bool = False, judge: Callable[[Run], Verdicts | None] | None = None
) -> Report:
    """Write the tables, summary, figures and page of the cells of config.json.

    A file that would be as it is stays untouched; a figure is drawn if the summary has changed, it
    is gone, or `redraw` says so.

    Args:
        folder: the run's.
        redraw: whether figures that are there are drawn again.
        judge: concludes from a run whose cells are all finished, or has nothing to say of it. It is
            not asked about single seeds, nor about seeds that are not watched for as long.

    Raises:
        UserError: if the folder holds no finished cell of a run, or a damaged one.
        OSError: if a file cannot be written.
    """
    written = run_folder.read(folder)
    config = written["config"]
    run = Run(folder, config, run_folder.solved(folder, written), tables.read(folder, config))
    ends = lifetime(config)
    summary = summarise(run.tables, run.threshold, config["max_episodes"])

    # Tables and summary. Figures and verdicts of another summary go before this one comes.
    tables.write(folder, run.tables)
    path, content = folder / "summary.csv", summary.write_csv().encode()
    if not path.is_file() or path.read_bytes() != content:
        for figure in (folder / "figures").glob("*.*"):
            figure.unlink()
        for name in ("claims.md", "report.html"):
            (folder / name).unlink(missing_ok=True)
    outputs.write(path, content)

    # Figures.
    by_episodes = ends.episodes is not None
    files = figures.files(folder / "figures", summary)
    there = all(file.exists() for of_figure in files.values() for file in of_figure)
    wrong: list[str] = []
    if redraw or not there:
        to, tell = folder / "figures", wrong.append
        figures.draw(to, run.tables, summary, run.threshold, tell, by_episodes=by_episodes)

    # Verdicts and page.
    whole = summary["seeds"].to_list() == [config["seeds"]] * _asked(config)
    verdicts = None
    if judge is not None and whole and config["seeds"] > 1 and not ends.mixed:
        verdicts = judge(run)
    if verdicts is None:
        (folder / "claims.md").unlink(missing_ok=True)
    else:
        outputs.write(folder / "claims.md", verdicts.markdown.encode())
    text = page.page(
        config,
        summary,
        run.threshold,
        {name: of_figure[0] for name, of_figure in files.items()},
        written["versions"],
        by_episodes=by_episodes,
        verdicts="" if verdicts is None else verdicts.html,
    )
    outputs.write(folder / "report.html", text.encode())
    return Report(summary, wrong)


def _asked(config: dict[str, Any]) -> int:
    """How many cells a configuration asks for."""
    return len(cells.asked(config["methods"], config["n_demos"]))
