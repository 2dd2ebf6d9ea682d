"""What a finished run's tables say: its summary and its figures."""

import polars as pl

from cmedirl_jax import demonstrations
from cmedirl_jax.envs import Env
from experiments import figures, kept_pool, results, statistics
from experiments.planning import Cell
from experiments.presets import Grid


def conclude(grid: Grid, env: Env, plan: list[Cell], *, redraw: bool) -> pl.DataFrame:
    """Summarise the run's tables; draw its figures where they are not there yet."""
    folder = grid.folder
    tables = results.read(folder)
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
                grid.max_episodes,
                interacts=cell.method.interacts,
            )
            for cell in plan
        ],
        infer_schema_length=None,
    )
    if redraw or not all((folder / name).exists() for name in ("summary.csv", "figures")):
        expert = None
        pool = kept_pool.load(folder, env)
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
        with results.replacing(folder / "summary.csv") as partial:
            summary.write_csv(partial)
    return summary
