"""A whole run: demonstrations, then cell after cell, then the summary and the figures."""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import polars as pl
from rich.console import Console

from cmedirl_jax import checkpoint, demonstrations, envs, hot_start, seeds
from cmedirl_jax.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from experiments import (
    cells,
    experts,
    figures,
    gymnasium_replay,
    judging,
    planning,
    results,
    statistics,
    tables,
)
from experiments.bookkeeping import Budget
from experiments.cells import Programs
from experiments.errors import UserError
from experiments.planning import Cell
from experiments.presets import Grid
from experiments.progress import Reporter, reporter

FRESH_STARTS = 100
"""Random start states on which each seed's best policy is judged at the end."""


class Keys(NamedTuple):
    """Independent randomness, all from the study's seed. Methods share it: seeds are paired."""

    learners: jax.Array
    experts: jax.Array
    fresh_starts: jax.Array


def run(grid: Grid, devices: list[jax.Device], console: Console) -> pl.DataFrame:
    """Do what is left of a run; returns its summary.

    Raises:
        UserError: for a configuration, a folder or a file that cannot work.
    """
    planning.check(grid)
    env = envs.make(grid.env)
    given = None if grid.demos is None else planning.load_demonstrations(grid, env)
    results.check_folder(grid)
    folder = grid.folder
    keys = Keys(*jax.random.split(jax.random.key(grid.seed), 3))
    plan = planning.cells_of(grid)
    done = results.finished(folder)
    todo = [cell for cell in plan if (cell.method.name, cell.n_demos) not in done]
    if todo:
        _train_cells(grid, env, keys, given, todo, devices, console)
    return _conclude(grid, env, folder, plan, redraw=bool(todo))


def _train_cells(
    grid: Grid,
    env: Env,
    keys: Keys,
    given: Demonstrations | None,
    todo: list[Cell],
    devices: list[jax.Device],
    console: Console,
) -> None:
    budget = planning.budget_of(grid, env)
    pool_path = grid.folder / "demonstrations" / "pool.npz"
    needs_pool = any(cell.n_demos for cell in todo)
    pool = given if given is not None else _reusable(pool_path, env)
    trains_experts = needs_pool and pool is None
    expert_steps = grid.experts.seeds * grid.experts.steps
    total = len(todo) * grid.seeds * budget.max_steps + expert_steps * trains_experts
    group = seeds.group_size(grid.seeds, len(devices), grid.settings.architecture.hidden)
    judge = judging.make(env, grid.settings.architecture, group, devices)
    programs: dict[str, Programs] = {}
    with reporter(console, len(todo) + trains_experts, total) as report:
        if trains_experts:
            report.start("experts")
            pool = experts.make_pool(
                keys.experts,
                env,
                grid.experts,
                grid.expert,
                devices,
                _stepwise(report, grid.experts.seeds),
            )
        if needs_pool:
            assert pool is not None
            planning.check_enough(grid, int(pool.episode[-1]) + 1)
        # Only now: a refusal, or a run stopped among the experts, leaves nothing behind.
        folder = results.open_folder(grid)
        if needs_pool:
            assert pool is not None
            if not pool_path.exists():
                pool_path.parent.mkdir(exist_ok=True)
                demonstrations.save(pool_path, pool)
        for cell in todo:
            report.start(cell.name)
            if cell.method.name not in programs:
                programs[cell.method.name] = cells.compile_method(
                    env,
                    cell.method,
                    grid.settings,
                    judge,
                    group=group,
                    seeds_count=grid.seeds,
                    devices=devices,
                    capacity=budget.max_steps,
                    subset_size=max(grid.n_demos),
                )
            _train_cell(
                grid, env, keys, folder, cell, pool, programs[cell.method.name], budget, report
            )


def _train_cell(
    grid: Grid,
    env: Env,
    keys: Keys,
    folder: Path,
    cell: Cell,
    pool: Demonstrations | None,
    programs: Programs,
    budget: Budget,
    report: Reporter,
) -> None:
    data = None
    if cell.n_demos:
        assert pool is not None
        data = hot_start.data(pool, grid.settings.hot_start.discount)
    result = cells.train(
        programs,
        keys.learners,
        data,
        cell.n_demos,
        seeds_count=grid.seeds,
        budget=budget,
        threshold=env.spec.reward_threshold,
        report=_stepwise(report, grid.seeds),
    )
    checkpoint.save(folder / "policies" / cell.name, result.best)
    if result.reward is not None:
        checkpoint.save(folder / "rewards" / cell.name, result.reward)
    fresh = programs.judge.on_fresh_starts(result.best, keys.fresh_starts, FRESH_STARTS)
    metadata = pool.metadata if cell.n_demos and pool is not None else {}
    rows = tables.rows(
        result,
        {
            "expert": metadata.get("expert", "file") if cell.n_demos else "none",
            "method": cell.method.name,
            "n_demos": cell.n_demos,
        },
        best_return=judging.summarise(fresh).return_mean,
        replay=gymnasium_replay.replay(programs.judge, result.best, env),
        expert_steps=int(metadata.get("expert_env_steps", 0)),
    )
    results.append(folder, rows)


def _reusable(path: Path, env: Env) -> Demonstrations | None:
    if not path.exists():
        return None
    try:
        return demonstrations.load(path, env.spec)
    except (OSError, ValueError) as error:
        raise UserError(f"--out: {error}; remove it to train the experts again") from error


def _stepwise(report: Reporter, seeds_count: int) -> Callable[[cells.Progress], None]:
    """Turn a cell's progress, which counts from its start, into increments."""
    before = 0

    def advance(progress: cells.Progress) -> None:
        nonlocal before
        report.advance((progress.env_step - before) * seeds_count, progress.solved_fraction)
        before = progress.env_step

    return advance


def _conclude(
    grid: Grid, env: Env, folder: Path, plan: list[Cell], *, redraw: bool
) -> pl.DataFrame:
    """Summarise the run's tables; draw its figures where they are not there yet."""
    loaded = {name: results.read(folder, name) for name in results.TABLES}
    evaluations, seed_rows, episodes = (
        loaded[name] for name in ("evaluations", "seeds", "episodes")
    )
    assert evaluations is not None
    assert seed_rows is not None
    assert episodes is not None

    def of(table: pl.DataFrame, cell: Cell) -> pl.DataFrame:
        return table.filter(
            (pl.col("method") == cell.method.name) & (pl.col("n_demos") == cell.n_demos)
        )

    summary = pl.DataFrame(
        [
            statistics.summarise(
                of(evaluations, cell),
                of(seed_rows, cell),
                env.spec.reward_threshold,
                episodes_bind=grid.max_steps is None,
            )
            for cell in plan
        ],
        infer_schema_length=None,
    )
    if redraw or not (folder / "summary.csv").exists():
        pool_path = folder / "demonstrations" / "pool.npz"
        expert = None
        pool = _reusable(pool_path, env)
        if pool is not None:
            expert = float(demonstrations.returns(pool).mean())
        figures.draw(
            folder / "figures", evaluations, episodes, summary, expert, env.spec.reward_threshold
        )
        with results.replacing(folder / "summary.csv") as partial:
            summary.write_csv(partial)
    return summary
