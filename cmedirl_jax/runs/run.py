"""A whole run: demonstrations, then cell after cell."""

import contextlib
import dataclasses
import errno
import functools
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import polars as pl
from rich.console import Console

from cmedirl_jax import envs
from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs import validation
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells import compiled as programs_lib
from cmedirl_jax.runs.cells import evaluator as evaluator_lib
from cmedirl_jax.runs.cells import experts, gymnasium_replay, tabular_cell
from cmedirl_jax.runs.cells.compiled import Programs
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.cluster import exchange, orbax_worker
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.console import compile_cache
from cmedirl_jax.runs.console.progress import Reporter, reporter
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage import sealing, tables
from cmedirl_jax.runs.storage.checkpoints import Keeper
from cmedirl_jax.runs.validation import Cell
from cmedirl_jax.training.methods import METHODS, Method, Settings

FRESH_STARTS = 100
"""Random start states on which each seed's best policy is judged at the end."""


class Keys(NamedTuple):
    """Independent randomness, all from the study's seed. Methods share it: seeds are paired."""

    learners: jax.Array
    experts: jax.Array
    fresh_starts: jax.Array


class _Session(NamedTuple):
    """What a run is given once and its parts share."""

    grid: StudyConfig
    env: Env
    budget: Budget
    keys: Keys
    devices: list[jax.Device]
    console: Console
    interruption: Interruption
    identity: dict[str, Any]

    def keeper(self, name: str) -> Keeper:
        """What saves the training that is called `name`."""
        return Keeper(
            self.grid.folder / "checkpoints" / name,
            self.identity,
            every=self.grid.checkpoint_every,
            interruption=self.interruption,
            say=functools.partial(
                self.console.print, markup=False, highlight=False, soft_wrap=True
            ),
        )


class _Compiled(NamedTuple):
    """Programs by method, each compiled once."""

    method: Callable[[Method, Settings], Programs]
    tabular: Callable[[Method], tabular_cell.Programs]


def run(
    grid: StudyConfig, devices: list[jax.Device], console: Console, interruption: Interruption
) -> pl.DataFrame | None:
    """Do what is left of a run; returns its summary, of several processes on process 0 alone.

    Raises:
        UserError: for a configuration, a folder or a file that cannot work.
        Interrupted: if a signal came; what was reached is saved.
        OSError: if a file could not be written; what was finished stays.
    """
    validation.check(grid)
    env = envs.make(grid.env)
    given = None
    if grid.demos is not None:
        given = exchange.pool_from_writer(lambda: validation.load_demonstrations(grid, env))
    plan = validation.cells_of(grid)
    with contextlib.ExitStack() as stack:

        def enter() -> dict[str, Any]:
            folder = stack.enter_context(run_folder.opened(grid))
            return {
                "finished": [list(cell) for cell in sealing.finished(folder)],
                "identity": run_folder.identity(grid),
                "began": run_folder.other_versions(folder),
            }

        found = exchange.from_writer(enter)
        todo = [cell for cell in plan if [cell.method.name, cell.n_demos] not in found["finished"]]
        if todo:
            kind = devices[0].platform.upper()
            console.print(f"{grid.seeds} seeds per cell on {len(devices)} {kind} device(s)")
            for name, version in found["began"].items():
                console.print(f"This run was begun with {name} {version}", highlight=False)
            session = _Session(
                grid,
                env,
                validation.budget_of(grid, env),
                Keys(*jax.random.split(jax.random.key(grid.seed), 3)),
                devices,
                console,
                interruption,
                found["identity"],
            )
            with compile_cache.counted() as cost, _within_memory(grid.folder):
                _train_cells(session, given, todo)
            console.print(
                f"Compilation took {cost.seconds:.1f} s; {cost.hits} programs came from the cache, "
                f"{cost.misses} did not",
                highlight=False,
            )
        if interruption.came():
            interruption.stop()
        if not exchange.is_writer():
            return None
        # What follows is done again at the next start if a signal ends it.
        interruption.release()
        shutil.rmtree(grid.folder / "checkpoints", ignore_errors=True)
        # Matplotlib and scipy take a second to import, which a refusal need not wait for.
        from experiments import conclusion

        return conclusion.conclude(grid, env, plan, redraw=bool(todo))


@contextlib.contextmanager
def _within_memory(folder: Path) -> Iterator[None]:
    """Turn a want of memory into an OSError, or a refusal as long as there is nothing to keep."""
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        said = ("RESOURCE_EXHAUSTED", "Out of memory")
        if not isinstance(error, MemoryError) and not any(words in str(error) for words in said):
            raise
        if sealing.begun(folder) or any((folder / "checkpoints").glob("*/*")):
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)) from error
        raise UserError(
            "the machine's memory is too small for this; give fewer --seeds, --max-steps or "
            "--evaluation-starts, or smaller networks"
        ) from error


def _train_cells(session: _Session, given: Demonstrations | None, todo: list[Cell]) -> None:
    grid, env, budget = session.grid, session.env, session.budget
    kept = exchange.pool_from_writer(lambda: stored_demonstrations.load(grid.folder, env))
    pool = kept if given is None else given
    trains_experts = pool is None and any(cell.n_demos for cell in todo)
    learners = grid.seeds * sum(cell.method.interacts for cell in todo)
    total = learners * budget.max_steps + grid.experts.seeds * grid.experts.steps * trains_experts
    compiled = _Compiled(
        programs_lib.compiler(grid, env, budget, session.devices),
        functools.cache(
            functools.partial(
                tabular_cell.compile_method,
                env,
                settings=grid.settings,
                devices=session.devices,
                subset_size=max(grid.n_demos),
            )
        ),
    )
    with reporter(session.console, len(todo) + trains_experts, total) as report:
        if trains_experts:
            report.start(f"experts, {grid.experts.seeds} seeds")
            with session.keeper("experts") as keeper:
                pool = _train_experts(session, compiled, keeper, report)
        data, metadata = None, {}
        if pool is not None:
            validation.check_enough(grid, int(pool.episode[-1]) + 1)
            agent = grid.settings.agent
            data = hot_start.data(pool, agent.discount, agent.reward_scale)
            metadata = pool.metadata
        if pool is not None and exchange.is_writer():
            if kept is None:
                stored_demonstrations.save(grid.folder, pool)
            shutil.rmtree(grid.folder / "checkpoints" / "experts", ignore_errors=True)
        for cell in todo:
            if session.interruption.came():
                session.interruption.stop()
            report.start(f"{cell.name}, {grid.seeds} seeds")
            with session.keeper(cell.name) as keeper:
                _train_cell(session, compiled, keeper, cell, data, metadata, report)


def _train_experts(
    session: _Session, compiled: _Compiled, keeper: Keeper, report: Reporter
) -> Demonstrations:
    grid = session.grid
    return experts.make_pool(
        session.keys.experts,
        session.env,
        grid.experts,
        grid.expert,
        compiled.method(METHODS["ddpg"], Settings()),
        _stepwise(report, grid.experts.seeds),
        keeper,
    )


def _train_cell(
    session: _Session,
    compiled: _Compiled,
    keeper: Keeper,
    cell: Cell,
    data: HotStartData | None,
    metadata: dict[str, Any],
    report: Reporter,
) -> None:
    """Train a cell, judge its policies, and write what came of it."""
    grid, env, keys, budget = session.grid, session.env, session.keys, session.budget
    if cell.method.tabular is None or cell.method.interacts:
        programs = compiled.method(cell.method, grid.settings)
        result = cell_lib.train(
            programs,
            keys.learners,
            data if cell.n_demos else None,
            cell.n_demos,
            seeds_count=grid.seeds,
            budget=budget if cell.method.interacts else dataclasses.replace(budget, max_steps=0),
            threshold=env.spec.reward_threshold,
            report=_stepwise(report, grid.seeds),
            keeper=keeper,
        )
    else:
        programs = compiled.tabular(cell.method)
        assert data is not None
        result = tabular_cell.train(
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
        best_return=evaluator_lib.summarise(fresh).return_mean,
        replay=gymnasium_replay.replay(programs.judge, result.best, env),
        expert_steps=metadata.get("expert_env_steps", 0) if cell.n_demos else 0,
    )
    if exchange.is_writer():
        keeper.wait()
        for name, tree in (("policies", result.best), ("rewards", result.reward)):
            path = grid.folder / name / cell.name
            # What a process left that was killed here before, whole or not.
            shutil.rmtree(path, ignore_errors=True)
            if tree is not None:
                orbax_worker.call(checkpoint.save, path, tree)
        sealing.append(grid.folder, rows)
        keeper.remove()


def _stepwise(report: Reporter, seeds_count: int) -> Callable[[cell_lib.Progress], None]:
    """Turn a cell's progress, which counts from its start, into increments."""
    before: int | None = None

    def advance(progress: cell_lib.Progress) -> None:
        nonlocal before
        if before is None:
            report.go_on(progress.env_step * seeds_count)
        else:
            report.advance((progress.env_step - before) * seeds_count, progress.solved_fraction)
        before = progress.env_step

    return advance
