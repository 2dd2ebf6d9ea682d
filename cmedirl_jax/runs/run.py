"""A whole run: demonstrations, then cell after cell."""

import contextlib
import dataclasses
import errno
import functools
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import polars as pl
from rich.console import Console

from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cells import experts, gymnasium_replay, tabular_cell
from cmedirl_jax.runs.cells.compiled import CompiledMethod
from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.console import compile_cache
from cmedirl_jax.runs.console.progress import Reporter, reporter
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells, plain, tables
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage.cells import CellKey
from cmedirl_jax.runs.storage.checkpoints import FOLDER as CHECKPOINTS
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.runs.validation import Cell, Plan
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings

EXPERTS = "experts"
"""The name of the experts' checkpoints."""
FRESH_STARTS = 100
"""Random start states on which each seed's best policy is evaluated at the end."""


class Keys(NamedTuple):
    """Independent randomness, all from the study's seed. Methods share it: seeds are paired."""

    learners: jax.Array
    experts: jax.Array
    fresh_starts: jax.Array


class Cell(NamedTuple):
    """A cell to be trained: a method, a number of demonstrations, a block of seeds."""

    method: Method
    n_demos: int
    block: range

    @property
    def name(self) -> str:
        """The name of its folder."""
        return cells.name(self.method.name, self.n_demos, self.block.start, len(self.block))

    @property
    def title(self) -> str:
        """What the progress calls it."""
        seeds = f"{len(self.block)} seeds"
        if self.block.start:
            seeds = f"seeds {self.block.start} to {self.block.stop - 1}"
        return f"{cells.stem(self.method.name, self.n_demos)}, {seeds}"


class _Pool(NamedTuple):
    """The demonstrations as cells use them.

    Attributes:
        data: for the learners; None if no cell needs any.
        metadata: of the pool.
    """

    data: HotStartData | None
    metadata: dict[str, Any]


class _Session(NamedTuple):
    """What a run is given once and its parts share."""

    plan: Plan
    keys: Keys
    console: Console
    interruption: Interruption
    cluster: Cluster
    compiled: Callable[[Method, Settings, int], CompiledMethod]
    compiled_fit: Callable[[Method], tabular_cell.CompiledFit]

    def checkpointer(self, name: str) -> Checkpointer:
        """Saves the training that is called `name`."""
        say = functools.partial(self.console.print, markup=False, highlight=False, soft_wrap=True)
        return Checkpointer(
            self.plan.folder / CHECKPOINTS / name,
            {"cell": name, **run_folder.identity(self.plan.config)},
            every=self.plan.checkpoint_every,
            interruption=self.interruption,
            say=say,
            cluster=self.cluster,
        )


def run(
    plan: Plan,
    devices: Sequence[Any],
    console: Console,
    interruption: Interruption,
    conclude: Callable[[Path], pl.DataFrame],
    cluster: Cluster = ALONE,
) -> pl.DataFrame | None:
    """Train the cells that are missing, then conclude.

    Args:
        plan: the run.
        devices: that share the seeds.
        console: where progress goes.
        interruption: the signals that have come.
        conclude: called last, on process 0 alone, with the run's folder: makes tables, figures and
            the summary from its cells. Called again at the next start if a signal ends it.
        cluster: the processes of the run.

    Returns:
        What `conclude` returned; None on the other processes.

    Raises:
        UserError: for a folder or a file that cannot be used.
        Interrupted: if a signal came; the training is saved.
        OSError: if a file could not be written; finished cells stay.
    """
    with contextlib.ExitStack() as stack:
        # Hold the folder, and find out which cells are missing.
        def enter() -> dict[str, Any]:
            opened = run_folder.opened(plan.folder, plan.config)
            finished = [cell.key for cell in stack.enter_context(opened)]
            blocks = [
                (method, n_demos, block.start, block.stop)
                for method, n_demos in plan.asked
                for block in cells.missing_blocks(
                    plan.folder, finished, method, n_demos, plan.seeds
                )
            ]
            return {"blocks": blocks, "began": run_folder.other_versions(plan.folder)}

        entered = cluster.from_writer(enter)
        todo = [
            Cell(METHODS[method], n_demos, range(first, stop))
            for method, n_demos, first, stop in entered["blocks"]
        ]

        # Train them.
        if todo:
            kind = devices[0].platform.upper()
            console.print(f"{plan.seeds} seeds per cell on {len(devices)} {kind} device(s)")
            for name, version in entered["began"].items():
                console.print(f"This run was begun with {name} {version}", highlight=False)
            session = _session(plan, devices, console, interruption, cluster)
            with compile_cache.counted() as cost, _within_memory(plan.folder):
                _train_cells(session, todo)
            console.print(
                f"Compilation took {cost.seconds:.1f} s; {cost.hits} programs came from the cache, "
                f"{cost.misses} did not",
                highlight=False,
            )
        if interruption.came():
            interruption.stop()

        # Make tables and figures.
        if not cluster.writer:
            return None
        interruption.release()
        names = [cell.path.name for cell in cells.finished(plan.folder)]
        run_folder.remove_checkpoints(plan.folder, names)
        run_folder.note_cells_asked(plan.folder, plan.config)
        return conclude(plan.folder)


def _session(
    plan: Plan,
    devices: Sequence[Any],
    console: Console,
    interruption: Interruption,
    cluster: Cluster,
) -> _Session:
    return _Session(
        plan,
        Keys(*jax.random.split(jax.random.key(plan.study), 3)),
        console,
        interruption,
        cluster,
        compiled_lib.compiler(
            plan.env,
            devices,
            capacity=plan.capacity,
            subset_size=plan.subset_size,
            least_slots=0 if plan.demos is not None else plan.experts.seeds,
            group=plan.group,
            gather=cluster.gather,
        ),
        functools.cache(
            functools.partial(
                tabular_cell.compile_method,
                plan.env,
                settings=plan.settings,
                devices=devices,
                subset_size=plan.subset_size,
                gather=cluster.gather,
            )
        ),
    )


@contextlib.contextmanager
def _within_memory(folder: Path) -> Iterator[None]:
    """Turn a lack of memory into a refusal, or into an OSError once something is saved."""
    try:
        yield
    except (MemoryError, jax.errors.JaxRuntimeError) as error:
        messages = ("RESOURCE_EXHAUSTED", "Out of memory")
        if not isinstance(error, MemoryError) and not any(m in str(error) for m in messages):
            raise
        if cells.any_begun(folder) or any((folder / CHECKPOINTS).glob("*/*")):
            raise OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)) from error
        raise UserError(
            "the machine's memory is too small for this; give fewer --seeds, --max-steps or "
            "--evaluation-starts, or smaller networks"
        ) from error


def _train_cells(session: _Session, todo: Sequence[Cell]) -> None:
    """Make the demonstrations if they are missing, and train the cells, with live progress."""
    plan, cluster = session.plan, session.cluster

    def load_stored() -> Demonstrations | None:
        with run_folder.naming_the_option():
            return stored_demonstrations.load(plan.folder, plan.env.spec)

    # The demonstrations, and how many steps there are to train.
    stored = cluster.pool_from_writer(load_stored)
    pool = stored if plan.demos is None else plan.demos
    trains_experts = pool is None and any(cell.n_demos for cell in todo)
    if pool is not None:
        plan.check_enough(pool)
    steps = sum(len(cell.block) * plan.budget.max_steps for cell in todo if cell.method.interacts)
    steps += plan.experts.seeds * plan.experts.steps * trains_experts

    # Experts if they are needed, then the cells.
    with reporter(session.console, len(todo) + trains_experts, steps) as report:
        if trains_experts:
            report.start(f"experts, {plan.experts.seeds} seeds")
            with session.checkpointer(EXPERTS) as checkpointer:
                pool = _train_experts(session, checkpointer, report)
            plan.check_enough(pool)
        if pool is not None and stored is None and cluster.writer:
            stored_demonstrations.save(plan.folder, pool)
        if pool is not None and cluster.writer:
            run_folder.remove_checkpoints(plan.folder, [EXPERTS])
        used = _Pool(None, {})
        if pool is not None:
            agent = plan.settings.agent
            data = hot_start.data(pool, agent.discount, agent.reward_scale)
            used = _Pool(data, pool.metadata)
        for cell in todo:
            if session.interruption.came():
                session.interruption.stop()
            report.start(cell.title)
            with session.checkpointer(cell.name) as checkpointer:
                _train_cell(session, checkpointer, cell, used, report)


def _train_experts(
    session: _Session, checkpointer: Checkpointer, report: Reporter
) -> Demonstrations:
    plan = session.plan
    return experts.make_pool(
        session.keys.experts,
        plan.env,
        plan.experts,
        plan.expert,
        session.compiled(METHODS["ddpg"], Settings(), plan.seeds),
        _stepwise(report, plan.experts.seeds),
        checkpointer,
        session.cluster,
    )


def _train_cell(
    session: _Session, checkpointer: Checkpointer, cell: Cell, pool: _Pool, report: Reporter
) -> None:
    """Train a cell, evaluate its best policies, and save it."""
    plan, keys, budget = session.plan, session.keys, session.plan.budget
    seeds = {"seeds_count": len(cell.block), "first_seed": cell.block.start}

    # Train.
    if cell.method.tabular is None or cell.method.interacts:
        programs = session.compiled(cell.method, plan.settings, len(cell.block))
        result = cell_lib.train(
            programs,
            keys.learners,
            pool.data if cell.n_demos else None,
            cell.n_demos,
            **seeds,
            budget=budget if cell.method.interacts else dataclasses.replace(budget, max_steps=0),
            threshold=plan.env.spec.reward_threshold,
            report=_stepwise(report, len(cell.block)),
            checkpointer=checkpointer,
        )
    else:
        programs = session.compiled_fit(cell.method)
        assert pool.data is not None
        result = tabular_cell.train(
            programs,
            keys.learners,
            pool.data,
            cell.n_demos,
            **seeds,
            evaluation_starts=budget.evaluation_starts,
            checkpointer=checkpointer,
        )

    # Evaluate each seed's best policy, in JAX and in Gymnasium.
    evaluator = programs.evaluator
    fresh = evaluator.on_fresh_starts(result.best, keys.fresh_starts, FRESH_STARTS)
    best_return = evaluator.summarise(fresh).return_mean
    replay = gymnasium_replay.replay(evaluator, result.best, plan.env)

    # Save.
    metadata: dict[str, Any] = pool.metadata if cell.n_demos else {"expert": "none"}
    key = CellKey(
        study=plan.study,
        expert=metadata.get("expert", "file"),
        method=cell.method.name,
        n_demos=cell.n_demos,
        first_seed=cell.block.start,
        seeds=len(cell.block),
    )
    rows = tables.rows(
        result,
        key,
        best_return=np.asarray(best_return),
        replay=replay,
        expert_steps=metadata.get("expert_env_steps", 0),
    )
    if session.cluster.writer:
        checkpointer.wait()
        description = {
            "task": plain.plain(plan.env.spec),
            "settings": plain.plain(plan.settings),
            "versions": run_folder.versions(),
        }
        trees = {"policies": result.best, "rewards": result.reward}
        cells.save(plan.folder, key, description, rows, trees, session.cluster.call)
        checkpointer.remove()


def _stepwise(report: Reporter, seeds_count: int) -> Callable[[cell_lib.Progress], None]:
    """Report a cell's progress, which counts from its first step, as increments."""
    before: int | None = None

    def advance(progress: cell_lib.Progress) -> None:
        nonlocal before
        if before is None:
            report.go_on(progress.env_step * seeds_count)
        else:
            report.advance((progress.env_step - before) * seeds_count, progress.solved_fraction)
        before = progress.env_step

    return advance
