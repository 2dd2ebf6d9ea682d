"""What a finished run's tables say: its summary and its figures."""

import polars as pl

from cmedirl_jax.data import demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import sealing
from cmedirl_jax.runs.validation import Cell
from experiments import figures


def conclude(config: StudyConfig, env: Env, plan: list[Cell], redraw: bool) -> pl.DataFrame:
    """Summarise the run's tables; draw its figures where they are not there yet."""
    folder = config.folder
    tables = sealing.read(folder)
    evaluations = tables["evaluations"]

    def of(table: pl.DataFrame, cell: Cell) -> pl.DataFrame:
        return table.filter(
            (pl.col("method") == cell.method.name) & (pl.col("n_demos") == cell.n_demos)
        )

    summary = pl.DataFrame(
        [
            statistics.summarise(
                of(evaluations, cell),
                of(tables["seeds"], cell),
                env.spec.reward_threshold,
                config.max_episodes,
                interacts=cell.method.interacts,
            )
            for cell in plan
        ],
        infer_schema_length=None,
    )
    if redraw or not all((folder / name).exists() for name in ("summary.csv", "figures")):
        expert = None
        pool = stored_demonstrations.load(folder, env)
        if pool is not None:
            expert = float(demonstrations.returns(pool).mean())
        figures.draw(
            folder / "figures",
            evaluations,
            tables["episodes"],
            summary,
            expert,
            env.spec.reward_threshold,
        )
        with sealing.replacing(folder / "summary.csv") as partial:
            summary.write_csv(partial)
    return summary
