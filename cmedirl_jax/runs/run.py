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
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cells import evaluator as evaluator_lib
from cmedirl_jax.runs.cells import experts, gymnasium_replay, tabular_cell
from cmedirl_jax.runs.cells.compiled import CompiledMethod
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
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.runs.validation import Cell
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings

FRESH_STARTS = 100
"""Random start states on which each seed's best policy is evaluated at the end."""


class Keys(NamedTuple):
    """Independent randomness, all from the study's seed. Methods share it: seeds are paired."""

    learners: jax.Array
    experts: jax.Array
    fresh_starts: jax.Array


class _Session(NamedTuple):
    """What a run is given once and its parts share."""

    config: StudyConfig
    env: Env
    budget: Budget
    keys: Keys
    devices: list[jax.Device]
    console: Console
    interruption: Interruption
    identity: dict[str, Any]

    def checkpointer(self, name: str) -> Checkpointer:
        """What saves the training that is called `name`."""
        return Checkpointer(
            self.config.folder / "checkpoints" / name,
            self.identity,
            every=self.config.checkpoint_every,
            interruption=self.interruption,
            say=functools.partial(
                self.console.print, markup=False, highlight=False, soft_wrap=True
            ),
        )


class _Compiled(NamedTuple):
    """What is compiled once for each method."""

    method: Callable[[Method, Settings], CompiledMethod]
    tabular: Callable[[Method], tabular_cell.CompiledFit]


def run(
    config: StudyConfig,
    devices: list[jax.Device],
    console: Console,
    interruption: Interruption,
    conclude: Callable[[StudyConfig, Env, list[Cell], bool], pl.DataFrame],
) -> pl.DataFrame | None:
    """Train the cells that are missing, then conclude.

    Args:
        config: the run.
        devices: that share the seeds.
        console: where progress goes.
        interruption: the signals that have come.
        conclude: called last, on process 0 alone, with the configuration, the environment, the
            run's cells, and whether any was trained just now. It reads the tables and summarises
            them. It is called again at the next start if a signal ends it.

    Returns:
        What `conclude` returned; None on the other processes.

    Raises:
        UserError: for a configuration, a folder or a file that cannot work.
        Interrupted: if a signal came; what was reached is saved.
        OSError: if a file could not be written; what was finished stays.
    """
    validation.check(config)
    env = envs.make(config.env)
    given = None
    if config.demos is not None:
        given = exchange.pool_from_writer(lambda: validation.load_demonstrations(config, env))
    plan = validation.cells_of(config)
    with contextlib.ExitStack() as stack:

        def enter() -> dict[str, Any]:
            folder = stack.enter_context(run_folder.opened(config))
            return {
                "finished": [list(cell) for cell in sealing.finished(folder)],
                "identity": run_folder.identity(config),
                "began": run_folder.other_versions(folder),
            }

        found = exchange.from_writer(enter)
        todo = [cell for cell in plan if [cell.method.name, cell.n_demos] not in found["finished"]]
        if todo:
            kind = devices[0].platform.upper()
            console.print(f"{config.seeds} seeds per cell on {len(devices)} {kind} device(s)")
            for name, version in found["began"].items():
                console.print(f"This run was begun with {name} {version}", highlight=False)
            session = _Session(
                config,
                env,
                validation.budget_of(config, env),
                Keys(*jax.random.split(jax.random.key(config.seed), 3)),
                devices,
                console,
                interruption,
                found["identity"],
            )
            with compile_cache.counted() as cost, _within_memory(config.folder):
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
        interruption.release()
        shutil.rmtree(config.folder / "checkpoints", ignore_errors=True)
        return conclude(config, env, plan, bool(todo))


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
    config, env, budget = session.config, session.env, session.budget
    kept = exchange.pool_from_writer(lambda: stored_demonstrations.load(config.folder, env))
    pool = kept if given is None else given
    trains_experts = pool is None and any(cell.n_demos for cell in todo)
    learners = config.seeds * sum(cell.method.interacts for cell in todo)
    total = (
        learners * budget.max_steps + config.experts.seeds * config.experts.steps * trains_experts
    )
    compiled = _Compiled(
        compiled_lib.compiler(config, env, budget, session.devices),
        functools.cache(
            functools.partial(
                tabular_cell.compile_method,
                env,
                settings=config.settings,
                devices=session.devices,
                subset_size=max(config.n_demos),
            )
        ),
    )
    with reporter(session.console, len(todo) + trains_experts, total) as report:
        if trains_experts:
            report.start(f"experts, {config.experts.seeds} seeds")
            with session.checkpointer("experts") as checkpointer:
                pool = _train_experts(session, compiled, checkpointer, report)
        data, metadata = None, {}
        if pool is not None:
            validation.check_enough(config, int(pool.episode[-1]) + 1)
            agent = config.settings.agent
            data = hot_start.data(pool, agent.discount, agent.reward_scale)
            metadata = pool.metadata
        if pool is not None and exchange.is_writer():
            if kept is None:
                stored_demonstrations.save(config.folder, pool)
            shutil.rmtree(config.folder / "checkpoints" / "experts", ignore_errors=True)
        for cell in todo:
            if session.interruption.came():
                session.interruption.stop()
            report.start(f"{cell.name}, {config.seeds} seeds")
            with session.checkpointer(cell.name) as checkpointer:
                _train_cell(session, compiled, checkpointer, cell, data, metadata, report)


def _train_experts(
    session: _Session, compiled: _Compiled, checkpointer: Checkpointer, report: Reporter
) -> Demonstrations:
    config = session.config
    return experts.make_pool(
        session.keys.experts,
        session.env,
        config.experts,
        config.expert,
        compiled.method(METHODS["ddpg"], Settings()),
        _stepwise(report, config.experts.seeds),
        checkpointer,
    )


def _train_cell(
    session: _Session,
    compiled: _Compiled,
    checkpointer: Checkpointer,
    cell: Cell,
    data: HotStartData | None,
    metadata: dict[str, Any],
    report: Reporter,
) -> None:
    """Train a cell, evaluator its policies, and write what came of it."""
    config, env, keys, budget = session.config, session.env, session.keys, session.budget
    if cell.method.tabular is None or cell.method.interacts:
        programs = compiled.method(cell.method, config.settings)
        result = cell_lib.train(
            programs,
            keys.learners,
            data if cell.n_demos else None,
            cell.n_demos,
            seeds_count=config.seeds,
            budget=budget if cell.method.interacts else dataclasses.replace(budget, max_steps=0),
            threshold=env.spec.reward_threshold,
            report=_stepwise(report, config.seeds),
            checkpointer=checkpointer,
        )
    else:
        programs = compiled.tabular(cell.method)
        assert data is not None
        result = tabular_cell.train(
            programs,
            keys.learners,
            data,
            cell.n_demos,
            seeds_count=config.seeds,
            evaluation_starts=config.evaluation_starts,
            checkpointer=checkpointer,
        )
    fresh = programs.evaluator.on_fresh_starts(result.best, keys.fresh_starts, FRESH_STARTS)
    rows = tables.rows(
        result,
        {
            "expert": metadata.get("expert", "file") if cell.n_demos else "none",
            "method": cell.method.name,
            "n_demos": cell.n_demos,
        },
        best_return=evaluator_lib.summarise(fresh).return_mean,
        replay=gymnasium_replay.replay(programs.evaluator, result.best, env),
        expert_steps=metadata.get("expert_env_steps", 0) if cell.n_demos else 0,
    )
    if exchange.is_writer():
        checkpointer.wait()
        for name, tree in (("policies", result.best), ("rewards", result.reward)):
            path = config.folder / name / cell.name
            # What a process left that was killed here before, whole or not.
            shutil.rmtree(path, ignore_errors=True)
            if tree is not None:
                orbax_worker.call(checkpoint.save, path, tree)
        sealing.append(config.folder, rows)
        checkpointer.remove()


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
