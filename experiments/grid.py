"""A whole run: demonstrations, then cell after cell, then the summary and the figures."""

import contextlib
import dataclasses
import functools
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import jax
import polars as pl
from rich.console import Console

from cmedirl_jax import checkpoint, demonstrations, envs, hot_start, seeds
from cmedirl_jax.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.methods import METHODS, Method, Settings
from cmedirl_jax.networks import Architecture
from experiments import (
    cells,
    compilation,
    distributed,
    experts,
    figures,
    gymnasium_replay,
    judging,
    planning,
    results,
    statistics,
    tables,
    tabular_cells,
)
from experiments import programs as programs_lib
from experiments.bookkeeping import Budget
from experiments.checkpoints import Keeper
from experiments.errors import UserError
from experiments.interruption import Interruption
from experiments.judging import Judge
from experiments.planning import Cell
from experiments.presets import Grid
from experiments.programs import Programs
from experiments.progress import Reporter, reporter

FRESH_STARTS = 100
"""Random start states on which each seed's best policy is judged at the end."""


class Keys(NamedTuple):
    """Independent randomness, all from the study's seed. Methods share it: seeds are paired."""

    learners: jax.Array
    experts: jax.Array
    fresh_starts: jax.Array


class _Session(NamedTuple):
    """What a run is given once and its parts share."""

    grid: Grid
    env: Env
    keys: Keys
    devices: list[jax.Device]
    console: Console
    interruption: Interruption

    def keeper(self, name: str) -> Keeper:
        """What saves the training that is called `name`."""
        return Keeper(
            self.grid.folder / "checkpoints" / name,
            results.identity(self.grid),
            every=self.grid.checkpoint_every,
            interruption=self.interruption,
            say=self.say,
        )

    def say(self, line: str) -> None:
        """Tell the user."""
        self.console.print(line, highlight=False, soft_wrap=True)


def run(
    grid: Grid, devices: list[jax.Device], console: Console, interruption: Interruption
) -> pl.DataFrame | None:
    """Do what is left of a run; returns its summary, of several processes on process 0 alone.

    Raises:
        UserError: for a configuration, a folder or a file that cannot work.
        Interrupted: if a signal came; what was reached is saved.
        OSError: if a file could not be written; what was finished stays.
    """
    planning.check(grid)
    env = envs.make(grid.env)
    given = None
    if grid.demos is not None:
        given = distributed.pool_from_writer(lambda: planning.load_demonstrations(grid, env))
    keys = Keys(*jax.random.split(jax.random.key(grid.seed), 3))
    plan = planning.cells_of(grid)
    folder = grid.folder
    with contextlib.ExitStack() as stack:
        distributed.from_writer(lambda: str(stack.enter_context(results.opened(grid))))
        done = distributed.from_writer(lambda: [list(cell) for cell in results.finished(folder)])
        todo = [cell for cell in plan if [cell.method.name, cell.n_demos] not in done]
        if todo:
            session = _Session(grid, env, keys, devices, console, interruption)
            kind = devices[0].platform.upper()
            console.print(f"{grid.seeds} seeds per cell on {len(devices)} {kind} device(s)")
            for name, version in distributed.from_writer(
                lambda: results.other_versions(folder)
            ).items():
                session.say(f"This run was begun with {name} {version}")
            with compilation.counted() as cost:
                _train_cells(session, given, todo)
            console.print(
                f"Compilation took {cost.seconds:.1f} s; {cost.hits} programs came from the cache, "
                f"{cost.misses} did not",
                highlight=False,
            )
        if not distributed.is_writer():
            return None
        shutil.rmtree(folder / "checkpoints", ignore_errors=True)
        return _conclude(grid, env, folder, plan, redraw=bool(todo))


def _train_cells(session: _Session, given: Demonstrations | None, todo: list[Cell]) -> None:
    grid, env, keys, devices, console, interruption = session
    budget = planning.budget_of(grid, env)
    pool_path = grid.folder / "demonstrations" / "pool.npz"
    needs_pool = any(cell.n_demos for cell in todo)
    pool = given
    if pool is None:
        pool = distributed.pool_from_writer(lambda: _reusable(pool_path, env))
    trains_experts = needs_pool and pool is None
    expert_steps = grid.experts.seeds * grid.experts.steps
    learners = grid.seeds * sum(cell.method.interacts for cell in todo)
    total = learners * budget.max_steps + expert_steps * trains_experts
    compile_method = _compiler(grid, env, devices, budget)
    compile_tabular = functools.cache(
        functools.partial(
            tabular_cells.compile_method,
            env,
            settings=grid.settings,
            devices=devices,
            subset_size=max(grid.n_demos),
        )
    )
    with reporter(console, len(todo) + trains_experts, total) as report:
        if trains_experts:
            report.start(f"experts, {grid.experts.seeds} seeds")
            pool = experts.make_pool(
                keys.experts,
                env,
                grid.experts,
                grid.expert,
                compile_method(METHODS["ddpg"], Settings()),
                _stepwise(report, grid.experts.seeds),
                session.keeper("experts"),
            )
        data, metadata = None, {}
        if pool is not None:
            planning.check_enough(grid, int(pool.episode[-1]) + 1)
            agent = grid.settings.agent
            data = hot_start.data(pool, agent.discount, agent.reward_scale)
            metadata = pool.metadata
        if pool is not None and distributed.is_writer() and not pool_path.exists():
            pool_path.parent.mkdir(exist_ok=True)
            demonstrations.save(pool_path, pool)
        for cell in todo:
            if interruption.came():
                interruption.stop()
            report.start(f"{cell.name}, {grid.seeds} seeds")
            keeper = session.keeper(cell.name)
            if cell.method.tabular is None or cell.method.interacts:
                programs = compile_method(cell.method, grid.settings)
                result = cells.train(
                    programs,
                    keys.learners,
                    data if cell.n_demos else None,
                    cell.n_demos,
                    seeds_count=grid.seeds,
                    budget=budget
                    if cell.method.interacts
                    else dataclasses.replace(budget, max_steps=0),
                    threshold=env.spec.reward_threshold,
                    report=_stepwise(report, grid.seeds),
                    keeper=keeper,
                )
            else:
                programs = compile_tabular(cell.method)
                assert data is not None
                result = tabular_cells.train(
                    programs,
                    keys.learners,
                    data,
                    cell.n_demos,
                    seeds_count=grid.seeds,
                    evaluation_starts=grid.evaluation_starts,
                    keeper=keeper,
                )
            fresh = programs.judge.on_fresh_starts(result.best, keys.fresh_starts, FRESH_STARTS)
            rows = tables.rows(
                result,
                {
                    "expert": metadata.get("expert", "file") if cell.n_demos else "none",
                    "method": cell.method.name,
                    "n_demos": cell.n_demos,
                },
                best_return=judging.summarise(fresh).return_mean,
                replay=gymnasium_replay.replay(programs.judge, result.best, env),
                expert_steps=metadata.get("expert_env_steps", 0) if cell.n_demos else 0,
            )
            if not distributed.is_writer():
                continue
            keeper.wait()
            save = functools.partial(distributed.alone, checkpoint.save)
            save(grid.folder / "policies" / cell.name, result.best)
            if result.reward is not None:
                save(grid.folder / "rewards" / cell.name, result.reward)
            results.append(grid.folder, rows)
            keeper.remove()


def _compiler(
    grid: Grid, env: Env, devices: list[jax.Device], budget: Budget
) -> Callable[[Method, Settings], Programs]:
    """A function that makes each method's programs once: for all cells, and for the experts too."""
    seeds_count, capacity = grid.seeds, budget.max_steps
    if grid.demos is None:
        seeds_count = max(seeds_count, grid.experts.seeds)
        capacity = max(capacity, grid.experts.steps)

    def group(architecture: Architecture) -> int:
        return grid.group or seeds.group_size(grid.seeds, len(devices), architecture.hidden)

    @functools.cache
    def judge(architecture: Architecture) -> Judge:
        return judging.of_networks(env, architecture, group(architecture), devices)

    @functools.cache
    def draw_networks(architecture: Architecture) -> Callable:
        return programs_lib.compile_networks(env, architecture, group(architecture), devices)

    @functools.cache
    def compile_method(method: Method, settings: Settings) -> Programs:
        return programs_lib.compile_method(
            env,
            method,
            settings,
            judge(settings.architecture),
            draw_networks(settings.architecture),
            group=group(settings.architecture),
            seeds_count=seeds_count,
            devices=devices,
            capacity=capacity,
            subset_size=max(grid.n_demos),
        )

    return compile_method


def _reusable(path: Path, env: Env) -> Demonstrations | None:
    if not path.exists():
        return None
    try:
        return demonstrations.load(path, env.spec)
    except (OSError, ValueError) as error:
        raise UserError(f"--out: {error}; remove it to train the experts again") from error


def _stepwise(report: Reporter, seeds_count: int) -> Callable[[cells.Progress], None]:
    """Turn a cell's progress, which counts from its start, into increments."""
    before: int | None = None

    def advance(progress: cells.Progress) -> None:
        nonlocal before
        if before is None:
            report.go_on(progress.env_step * seeds_count)
        else:
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
                grid.max_episodes,
                interacts=cell.method.interacts,
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
