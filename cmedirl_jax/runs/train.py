"""Training the cells of a run, and the experts whose demonstrations they use."""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from rich.console import Console

from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.data.hot_start_data import HotStartData
from cmedirl_jax.envs import Env
from cmedirl_jax.runs import numerics
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cells import experts, gymnasium_replay, scale, tabular_cell
from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.compiled import CompiledMethod
from cmedirl_jax.runs.cells.evaluator import Evaluator
from cmedirl_jax.runs.cells.pools import LearnersPool
from cmedirl_jax.runs.cluster.base import Cluster
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.console.phases import phase
from cmedirl_jax.runs.console.progress import Reporter, reporter, stepwise
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.loggers.background import CellLog
from cmedirl_jax.runs.storage import cells, checkpoints, plain, tables
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.runs.storage.cells import CellKey
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.runs.validation import Plan
from cmedirl_jax.training import seeds
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
        """Its name in the progress."""
        seeds = f"{len(self.block)} seeds"
        if self.block.start:
            seeds = f"seeds {self.block.start} to {self.block.stop - 1}"
        return f"{cells.stem(self.method.name, self.n_demos)}, {seeds}"


class Session(NamedTuple):
    """The plan and the means of a run, which its cells share."""

    plan: Plan
    keys: Keys
    console: Console
    interruption: Interruption
    cluster: Cluster
    compiled: Callable[[Method, Settings, int], CompiledMethod]
    compiled_fit: Callable[[Method], tabular_cell.CompiledFit]
    place: Callable[[HotStartData], HotStartData]

    def checkpointer(self, name: str) -> Checkpointer:
        """Saves the training that is called `name`."""
        return Checkpointer(
            self.plan.folder / checkpoints.FOLDER / name,
            {"cell": name, **run_folder.identity(self.plan.config)},
            every=self.plan.checkpoint_every,
            interruption=self.interruption,
            say=functools.partial(screen.say, self.console),
            cluster=self.cluster,
        )

    def log(self, cell: Cell, pool: LearnersPool | None) -> CellLog:
        """Logs a cell, on process 0."""
        return CellLog(
            self.plan.folder / run_folder.LOG / cell.name,
            self.plan.log if self.cluster.writer else (),
            cell.block,
            each_seed=self.plan.log_seeds,
            experts=pool.expert if pool is not None and cell.n_demos else None,
            config=self.plan.config,
        )


def session_of(
    plan: Plan,
    devices: Sequence[Any],
    console: Console,
    interruption: Interruption,
    cluster: Cluster,
) -> Session:
    """The session of a run; its programs are compiled at their first use."""
    in_one_block = plan.together == plan.seeds
    return Session(
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
            # Blocks of learners must not have the slots of all experts.
            least_slots=plan.experts.seeds if in_one_block and plan.demos is None else 0,
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
        # On every device once, rather than at each call.
        lambda data: data._replace(
            transition=jax.device_put(data.transition, seeds.replicated(devices))
        ),
    )


def train_cells(session: Session, todo: Sequence[Cell]) -> None:
    """Make the demonstrations if they are missing, and train the cells, with live progress."""
    plan, cluster = session.plan, session.cluster

    def load_stored() -> Demonstrations | None:
        with run_folder.naming_the_option():
            return stored_demonstrations.load(plan.folder)

    # The demonstrations, and how many steps there are to train.
    stored = cluster.pool_from_writer(load_stored)
    pool = stored if plan.demos is None else plan.demos
    # Where the task has no threshold, the best expert says what counts as solved.
    needed = any(cell.n_demos for cell in todo) or plan.env.spec.reward_threshold is None
    trains_experts = pool is None and needed
    used = None if pool is None else plan.of_learners(pool)
    steps = sum(len(cell.block) * plan.budget.max_steps for cell in todo if cell.method.interacts)
    steps += plan.experts.seeds * plan.experts.steps * trains_experts

    # Experts if they are needed, then the cells.
    with reporter(session.console, len(todo) + trains_experts, steps) as report:
        if trains_experts:
            only = "" if any(cell.n_demos for cell in todo) else ", to tell what counts as solved"
            report.start(f"experts, {plan.experts.seeds} seeds{only}")
            with session.checkpointer(EXPERTS) as checkpointer:
                pool = _train_experts(session, checkpointer, report)
            used = plan.of_learners(pool)
            screen.say(session.console, _who_demonstrates(pool, plan.seeds))
        if used is not None:
            used = used._replace(data=session.place(used.data))
        if pool is not None and stored is None and cluster.writer:
            stored_demonstrations.save(plan.folder, pool)
        if pool is not None and cluster.writer:
            run_folder.remove_checkpoints(plan.folder, [EXPERTS])
        solved = plan.env.spec.reward_threshold if pool is None else _note_scale(session, pool)
        assert solved is not None
        for cell in todo:
            if session.interruption.came():
                session.interruption.stop()
            report.start(cell.title)
            with session.checkpointer(cell.name) as checkpointer:
                _train_cell(session, checkpointer, cell, used, solved, report)


def _who_demonstrates(pool: Demonstrations, learners: int) -> str:
    known = pool.metadata
    solved, trained = known["experts_solved"], known["experts_trained"]
    chosen = f"{len(known['experts_demonstrating'])} demonstrate for {learners} learners"
    return f"{solved} of {trained} experts solve the task; {chosen}"


def _note_scale(session: Session, pool: Demonstrations) -> float:
    """Measure the task's returns and rewards, say and store them; what counts as solved."""
    plan = session.plan

    def measure() -> dict[str, Any]:
        # What a run was begun with stays: its finished cells were judged by it.
        noted = run_folder.read(plan.folder).get("scale")
        if noted is not None:
            return noted
        found = scale.measure(plan.env, pool, plan.budget.evaluation_starts)
        run_folder.note_scale(plan.folder, found._asdict())
        return found._asdict()

    found = scale.Scale(**session.cluster.from_writer(measure))
    who = "best expert" if plan.demos is None else "demonstrations"
    session.console.print(
        f"Returns: random actions {found.random:.4g}, {who} {_known(found.expert)}, solved "
        f"from {found.solved:.4g}. Rewards of a step spread by {found.reward_spread_random:.2g} in "
        f"random episodes, {_known(found.reward_spread_demonstrated)} in demonstrated ones",
        highlight=False,
    )
    return found.solved


def _known(number: float | None) -> str:
    return "unknown" if number is None else f"{number:.4g}"


def _train_experts(
    session: Session, checkpointer: Checkpointer, report: Reporter
) -> Demonstrations:
    plan = session.plan
    count = plan.experts.seeds
    if isinstance(plan.env, Env):
        # Experts are stepped in groups as learners are, and share what is compiled where they fit.
        count = plan.seeds if plan.together == plan.seeds else max(plan.together, count)
    return experts.make_pool(
        session.keys.experts,
        plan.env,
        plan.experts,
        session.compiled(METHODS["ddpg"], plan.experts.settings, count),
        plan.budget.evaluation_starts,
        stepwise(report, plan.experts.seeds),
        checkpointer,
        session.cluster,
    )


def _train_cell(
    session: Session,
    checkpointer: Checkpointer,
    cell: Cell,
    pool: LearnersPool | None,
    solved: float,
    report: Reporter,
) -> None:
    """Train a cell, evaluate its best policies, and save it."""
    with session.log(cell, pool) as log:
        result, evaluator = _train(session, checkpointer, cell, pool, solved, report, log)
    plan, fresh_starts = session.plan, session.keys.fresh_starts

    # Evaluate each seed's best policy, in JAX and in Gymnasium.
    with phase("evaluation"):
        fresh = evaluator.on_fresh_starts(result.best, fresh_starts, FRESH_STARTS)
        best_return = evaluator.summarise(fresh).return_mean
    with phase("Gymnasium"):
        replay = gymnasium_replay.replay(evaluator, result.best, plan.env)

    # Save.
    demonstrated = pool if cell.n_demos else None
    key = CellKey(
        study=plan.study,
        expert="none" if demonstrated is None else demonstrated.metadata.get("expert", "file"),
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
        pool=demonstrated,
    )
    if session.cluster.writer:
        checkpointer.wait()
        description = {
            "task": plain.plain(plan.env.spec),
            "settings": plain.plain(plan.settings),
            "versions": run_folder.versions(),
            "numerics": numerics.current(),
        }
        trees = {"policies": result.best, "rewards": result.reward}
        with phase("saving"):
            cells.save(plan.folder, key, description, rows, trees, session.cluster.call)
        checkpointer.remove()


def _train(
    session: Session,
    checkpointer: Checkpointer,
    cell: Cell,
    pool: LearnersPool | None,
    solved: float,
    report: Reporter,
    log: CellLog,
) -> tuple[CellResult, Evaluator]:
    """Train a cell; gives its evaluator too."""
    plan, key, budget = session.plan, session.keys.learners, session.plan.budget
    block = {"seeds_count": len(cell.block), "first_seed": cell.block.start}
    if cell.method.tabular is not None and not cell.method.interacts:
        fit = session.compiled_fit(cell.method)
        assert pool is not None
        result = tabular_cell.train(
            fit,
            key,
            pool.data,
            cell.n_demos,
            **block,
            evaluation_starts=budget.evaluation_starts,
            checkpointer=checkpointer,
        )
        log.follow(result.evaluations)
        return result, fit.evaluator
    programs = session.compiled(cell.method, plan.settings, len(cell.block))
    result = cell_lib.train(
        programs,
        key,
        pool.data if pool is not None and cell.n_demos else None,
        cell.n_demos,
        **block,
        budget=budget if cell.method.interacts else dataclasses.replace(budget, max_steps=0),
        threshold=solved,
        report=stepwise(report, len(cell.block), log.follow),
        checkpointer=checkpointer,
    )
    return result, programs.evaluator
