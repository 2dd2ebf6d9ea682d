"""A whole run: demonstrations, then cell after cell, then the summary and the figures."""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import polars as pl
from rich.console import Console

from cmedirl_jax import checkpoint, demonstrations, envs, hot_start, seeds
from cmedirl_jax.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.methods import METHODS, Method
from experiments import (
    cells,
    experts,
    figures,
    gymnasium_replay,
    judging,
    results,
    statistics,
    tables,
)
from experiments.cells import Budget, Programs
from experiments.errors import UserError
from experiments.presets import Grid
from experiments.progress import Reporter, reporter

FRESH_STARTS = 100
"""Random start states on which each seed's best policy is judged at the end."""


class Cell(NamedTuple):
    """A method and its number of demonstrations; 0 for a method that uses none."""

    method: Method
    n_demos: int

    @property
    def name(self) -> str:
        """The cell's name in paths and progress."""
        return f"{self.method.name}-n{self.n_demos}" if self.n_demos else self.method.name


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
    check(grid)
    env = envs.make(grid.env)
    given = None if grid.demos is None else load_demonstrations(grid, env)
    folder = results.open_folder(grid)
    keys = Keys(*jax.random.split(jax.random.key(grid.seed), 3))
    plan = cells_of(grid)
    done = results.finished(folder)
    todo = [cell for cell in plan if (cell.method.name, cell.n_demos) not in done]
    if todo:
        _train_cells(grid, env, keys, folder, given, todo, devices, console)
    return _conclude(grid, env, folder, plan, redraw=bool(todo))


def check(grid: Grid) -> None:
    """Refuse what can be refused before any work.

    Raises:
        UserError: naming the option, what is wrong and what would be right.
    """
    for method in grid.methods:
        if method not in METHODS:
            raise UserError(f"--methods: unknown method {method!r}; there are {', '.join(METHODS)}")
    try:
        envs.make(grid.env)
    except ValueError as error:
        raise UserError(f"--env: {error}") from error
    for name in ("methods", "n_demos"):
        values = getattr(grid, name)
        if not values or len(set(values)) < len(values):
            raise UserError(f"--{name.replace('_', '-')}: give one or more, each once")
    if grid.max_steps is None and grid.max_episodes is None:
        raise UserError("--max-steps: give a number, or give --max-episodes")
    if grid.seed < 0:
        raise UserError(f"--seed: must not be negative, got {grid.seed}")
    for name, value in _positive(grid):
        if value is not None and value < 1:
            raise UserError(f"--{name.replace('_', '-')}: must be at least 1, got {value}")


def _positive(grid: Grid) -> list[tuple[str, int | None]]:
    """Options that must be positive."""
    settings = grid.settings
    named = [("n_demos", number) for number in grid.n_demos]
    named += [
        (name, getattr(grid, name))
        for name in (
            "seeds",
            "max_steps",
            "max_episodes",
            "evaluate_every",
            "evaluation_starts",
            "evaluate_every_episodes",
            "evaluation_starts_episodes",
            "devices",
        )
    ]
    groups: list[tuple[str, Any, tuple[str, ...]]] = [
        ("experts", grid.experts, ("seeds", "steps", "trajectories")),
        (
            "schedule",
            settings.schedule,
            (
                "batch_size",
                "replay_capacity",
                "update_period",
                "target_period",
                "behaviour_cloning_steps",
            ),
        ),
        (
            "reward_schedule",
            settings.reward_schedule,
            ("period", "iterations", "anneal_steps", "batch_size", "recent"),
        ),
        ("hot_start", settings.hot_start, ("cells", "batch_size")),
    ]
    for prefix, options, names in groups:
        named += [(f"{prefix}.{name}", getattr(options, name)) for name in names]
    for units in (*settings.architecture.hidden, *settings.reward_schedule.hidden):
        named.append(("architecture.hidden", units))
    return named


def cells_of(grid: Grid) -> list[Cell]:
    """The grid's cells; a method without demonstrations has one."""
    return [
        Cell(METHODS[name], n_demos)
        for name in grid.methods
        for n_demos in (grid.n_demos if METHODS[name].uses_demonstrations else (0,))
    ]


def budget_of(grid: Grid, env: Env) -> Budget:
    """How long each learner trains."""
    most = [grid.max_steps]
    if grid.max_episodes is not None:
        most.append(grid.max_episodes * env.spec.max_episode_steps)
    return Budget(
        max_steps=min(steps for steps in most if steps is not None),
        max_episodes=grid.max_episodes,
        evaluate_every=grid.evaluate_every,
        evaluation_starts=grid.evaluation_starts,
        evaluate_every_episodes=grid.evaluate_every_episodes,
        evaluation_starts_episodes=grid.evaluation_starts_episodes,
    )


def load_demonstrations(grid: Grid, env: Env) -> Demonstrations:
    """The file that `--demos` names.

    Raises:
        UserError: if it is missing, damaged, foreign, or holds too few.
    """
    assert grid.demos is not None
    try:
        pool = demonstrations.load(grid.demos, env.spec)
    except FileNotFoundError as error:
        raise UserError(f"--demos: there is no file {grid.demos}") from error
    except (OSError, ValueError) as error:
        raise UserError(f"--demos: {error}") from error
    _check_enough(grid, pool)
    return pool


def _check_enough(grid: Grid, pool: Demonstrations) -> None:
    held = int(pool.episode[-1]) + 1
    if max(grid.n_demos) > held and any(cell.n_demos for cell in cells_of(grid)):
        raise UserError(f"--n-demos: {max(grid.n_demos)} asked, the pool holds {held}")


def _train_cells(
    grid: Grid,
    env: Env,
    keys: Keys,
    folder: Path,
    given: Demonstrations | None,
    todo: list[Cell],
    devices: list[jax.Device],
    console: Console,
) -> None:
    budget = budget_of(grid, env)
    pool_path = folder / "demonstrations" / "pool.npz"
    needs_pool = any(cell.n_demos for cell in todo)
    pool = given if given is not None else _reusable(pool_path, grid, env)
    trains_experts = needs_pool and pool is None
    expert_steps = grid.experts.seeds * grid.experts.steps
    total = len(todo) * grid.seeds * budget.max_steps + expert_steps * trains_experts
    width = max(grid.settings.architecture.hidden)
    group = seeds.group_size(grid.seeds, len(devices), width)
    judge = judging.make(env, grid.settings.architecture, group, devices)
    programs: dict[str, Programs] = {}
    with reporter(console, len(todo) + trains_experts, total) as report:
        if trains_experts:
            if max(grid.n_demos) > grid.experts.trajectories:
                raise UserError(
                    f"--n-demos: {max(grid.n_demos)} asked, the pool will hold "
                    f"{grid.experts.trajectories}; raise --experts.trajectories"
                )
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
            _check_enough(grid, pool)
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


def _reusable(path: Path, grid: Grid, env: Env) -> Demonstrations | None:
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
        if pool_path.exists():
            expert = float(demonstrations.returns(demonstrations.load(pool_path)).mean())
        figures.draw(
            folder / "figures", evaluations, episodes, summary, expert, env.spec.reward_threshold
        )
        with results.replacing(folder / "summary.csv") as partial:
            summary.write_csv(partial)
    return summary
