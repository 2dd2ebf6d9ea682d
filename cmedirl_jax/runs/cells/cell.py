"""Training one cell: a method, a number of demonstrations, a block of seeds side by side."""

import functools
from collections.abc import Callable, Iterator, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.runs.cells.compiled import CompiledMethod, abstract, begin, pack
from cmedirl_jax.runs.cells.record import Budget, EpisodeRows, EvaluationRows, Record
from cmedirl_jax.runs.cells.slots import Slots
from cmedirl_jax.runs.console.phases import phase
from cmedirl_jax.runs.storage.checkpoints import Checkpointer, Snapshot
from cmedirl_jax.training import TrainingState
from cmedirl_jax.training.evaluation import Evaluation

CHUNK = 250
"""Steps per call of the compiled training loop; the host looks at the seeds in between."""


class Progress(NamedTuple):
    """Where a cell stands: steps taken by each seed, share at the threshold, all evaluations."""

    env_step: int
    solved_fraction: float
    evaluations: Sequence[EvaluationRows]


class CellResult(NamedTuple):
    """A finished cell. Its seeds count from 0, whatever their numbers in the study are.

    Attributes:
        evaluations: in the order they were made.
        episodes: in the order they ended.
        best: actor parameters `[seeds, ...]`, each seed's at its highest evaluation.
        reward: learned rewards' parameters `[seeds, ...]`, or None.
        env_steps: `[seeds]`, steps each learned from.
        demonstration_steps: `[seeds]`, environment steps in each seed's own demonstrations.
        diverged: `[seeds]` bool, stopped because a parameter was no longer finite.
        final: actor parameters `[seeds, ...]` at the end.
    """

    evaluations: list[EvaluationRows]
    episodes: EpisodeRows
    best: Any
    reward: Any
    env_steps: np.ndarray
    demonstration_steps: np.ndarray
    diverged: np.ndarray
    final: Any


def train(
    programs: CompiledMethod,
    key: jax.Array,
    data: HotStartData | None,
    n_demos: int,
    *,
    seeds_count: int,
    first_seed: int = 0,
    budget: Budget,
    threshold: float,
    report: Callable[[Progress], None],
    checkpointer: Checkpointer | None = None,
) -> CellResult:
    """Train a cell.

    Args:
        programs: of the cell's method.
        key: the cell's randomness.
        data: the demonstrations, with `episodes` `[learners, E]`: those that each learner of the
            study draws from; None for a method without.
        n_demos: how many of them each seed draws.
        seeds_count: how many seeds.
        first_seed: the number of the first of them in the study.
        budget: how long they train, and when they are evaluated.
        threshold: return that counts as solved, for the reports alone.
        report: called at the first step or the checkpoint's, and after each chunk.
        checkpointer: saves the training as it goes, and loads what was saved of it before.

    Raises:
        Interrupted: by the checkpointer.
    """
    slots = Slots(programs.slots, seeds_count, programs.group, programs.devices)

    # Begin, or continue from a checkpoint.
    shapes = functools.cache(lambda: abstract(programs, data, n_demos))
    saved = None
    if checkpointer is not None:
        saved = checkpointer.load(
            lambda arrays: _saved_like(shapes(), seeds_count, n_demos, arrays)
        )
    if saved is None:
        with phase("beginning"):
            state = jax.block_until_ready(begin(programs, slots, key, data, n_demos, first_seed))
        training = _Training.begin(programs, data, n_demos, budget, slots, state)
    else:
        training = _Training.resume(programs, data, n_demos, budget, slots, shapes(), saved)

    # Train, chunk after chunk.
    report(training.progress(threshold))
    for stop in _chunk_ends(training.step, budget):
        if not training.record.running.any():
            break
        training.advance(stop)
        report(training.progress(threshold))
        if checkpointer is not None:
            checkpointer.save_if_due(stop, training.snapshot)
    return training.result()


class _Training:
    """A cell in training: its seeds in their slots, their record, and the best policy of each."""

    def __init__(
        self,
        programs: CompiledMethod,
        data: HotStartData | None,
        n_demos: int,
        record: Record,
        slots: Slots,
        state: TrainingState,
    ):
        self.programs, self.data, self.n_demos, self.record = programs, data, n_demos, record
        self.slots, self.state, self.step = slots, state, 0
        self.best: Any = None
        self.best_return: Any = None

    @classmethod
    def begin(
        cls,
        programs: CompiledMethod,
        data: HotStartData | None,
        n_demos: int,
        budget: Budget,
        slots: Slots,
        state: TrainingState,
    ) -> "_Training":
        """Evaluate the seeds before their first step."""
        training = cls(programs, data, n_demos, Record(slots.seeds, budget), slots, state)
        every = np.arange(slots.seeds)
        evaluation = training._evaluate(
            budget.evaluation_starts, slots.groups(np.ones(slots.seeds, bool))
        )
        training.best = _take(state.agent.actor, slots.of_seed)
        training.best_return = jnp.asarray(evaluation.return_mean)
        training.record.evaluated("steps", every, evaluation)
        return training

    @classmethod
    def resume(
        cls,
        programs: CompiledMethod,
        data: HotStartData | None,
        n_demos: int,
        budget: Budget,
        slots: Slots,
        abstract: TrainingState,
        saved: Snapshot,
    ) -> "_Training":
        """Continue from a checkpoint."""
        slot_seed = saved.record.pop("slot_seed")
        state = saved.state["training"]
        if abstract.subset is not None:
            state = _with_padding(state, abstract.subset.start.shape[1])
        if slot_seed.size == slots.seed.size:
            # Every seed in the slot that it had: elsewhere in its group it might round otherwise.
            slots.seed = slot_seed
        else:
            slot = np.argsort(slot_seed)[np.minimum(slots.seed, slots.seeds - 1)]
            state = jax.tree.map(lambda leaf: leaf[slot], state)
        state = jax.tree.map(_typed, abstract, jax.device_put(state, programs.sharding))
        state = programs.resume(state, saved.step)
        record = Record.from_arrays(saved.record, budget)
        training = cls(programs, data, n_demos, record, slots, state)
        training.step = saved.step
        training.best, training.best_return = saved.state["best"], saved.state["best_return"]
        return training

    def snapshot(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """State and record as copies on the host, which training does not write over."""
        tree = {
            "training": jax.tree.map(_untyped, self.state),
            "best": self.best,
            "best_return": self.best_return,
        }
        tree = jax.tree.map(np.array, self.programs.evaluator.gather(tree))
        # Without the padding, whose size depends on the other cells that a command asks for.
        tree["training"] = _without_padding(tree["training"], self.n_demos)
        arrays = {"slot_seed": self.slots.seed.copy(), **self.record.to_arrays()}
        return tree, arrays

    def advance(self, stop: int) -> None:
        """Take the steps up to `stop`, and evaluate the seeds that are due."""
        # Train the seeds that run, and those that await their last evaluation.
        record, budget, slots = self.record, self.record.budget, self.slots
        active = record.running | (record.pending & ~record.diverged)
        self.state, groups = pack(self.programs, slots, self.state, active)
        limit = None if budget.max_episodes is None else jnp.int32(budget.max_episodes)
        steps = jnp.arange(self.step, stop, dtype=jnp.int32)
        with phase("training"):
            self.state, log = self.programs.run(self.state, groups, self.data, steps, limit)
            finite, log = self._of_seeds((_finite(self.state), log))
        self.step = stop

        # Record what they did, and stop those that diverged.
        was_running = record.running.copy()
        record.mark_diverged(finite)
        record.stepped(steps=np.asarray(steps), log=log)

        # Evaluate by episodes.
        due = np.flatnonzero(record.due_by_episodes() & ~record.diverged)
        if due.size:
            evaluation = self._evaluate(budget.evaluation_starts_episodes, groups)
            record.evaluated("episodes", due, evaluation)

        # Evaluate by steps, and keep each seed's best policy.
        record.pending |= was_running
        over = stop == budget.max_steps or not record.running.any()
        if stop % budget.evaluate_every == 0 or over:
            evaluation = self._evaluate(budget.evaluation_starts, groups)
            due = np.flatnonzero(record.pending & ~record.diverged)
            record.evaluated("steps", due, evaluation)
            record.pending[:] = False
            returns = np.full(slots.seeds, -np.inf, np.float32)
            returns[due] = evaluation.return_mean[due]
            actor = _take(self.state.agent.actor, slots.of_seed)
            self.best, self.best_return = _keep_best(self.best, self.best_return, actor, returns)

    def progress(self, threshold: float) -> Progress:
        """Where the cell stands."""
        solved = self.record.solved_fraction(threshold)
        return Progress(self.step, solved, self.record.evaluations)

    def result(self) -> CellResult:
        """The finished cell."""
        record, state = self.record, self.state
        return CellResult(
            evaluations=record.evaluations,
            episodes=record.episode_rows(),
            best=self.programs.evaluator.gather(self.best),
            reward=None if state.reward is None else self._of_seeds(state.reward.params),
            env_steps=record.env_step,
            demonstration_steps=np.zeros(self.slots.seeds, np.int32)
            if state.subset is None
            else self._of_seeds(state.subset.length).sum(axis=1),
            diverged=record.diverged,
            final=self._of_seeds(state.agent.actor),
        )

    def _of_seeds(self, tree: Any) -> Any:
        """Arrays `[slots, ...]` as numpy `[seeds, ...]`."""
        index = self.slots.of_seed
        return jax.tree.map(lambda leaf: leaf[index], self.programs.evaluator.gather(tree))

    def _evaluate(self, starts: int, groups: int) -> Evaluation:
        evaluator = self.programs.evaluator
        with phase("evaluation"):
            rollouts = evaluator.on_starts(self.state.agent.actor, starts, groups)
            return self._of_seeds(evaluator.summarise(rollouts))


def _saved_like(
    abstract: TrainingState, seeds_count: int, n_demos: int, arrays: dict[str, np.ndarray]
) -> dict[str, Any]:
    """The tree that `_Training.snapshot` saved along with `arrays`, with shapes for arrays."""

    def sized(count: int, tree: Any) -> Any:
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct((count, *leaf.shape[1:]), leaf.dtype), tree
        )

    def untyped(state: TrainingState) -> TrainingState:
        return _without_padding(jax.tree.map(_untyped, state), n_demos)

    state = jax.eval_shape(untyped, abstract)
    return {
        "training": sized(arrays["slot_seed"].size, state),
        "best": sized(seeds_count, state.agent.actor),
        "best_return": jax.ShapeDtypeStruct((seeds_count,), jnp.float32),
    }


def _without_padding(state: TrainingState, n_demos: int) -> TrainingState:
    """The state with its demonstrations alone, of arrays or of their shapes."""
    return state.replace(subset=jax.tree.map(lambda leaf: leaf[:, :n_demos], state.subset))


def _with_padding(state: TrainingState, size: int) -> TrainingState:
    """The state, of numpy arrays, with its demonstrations padded to `size`."""

    def padded(leaf: np.ndarray) -> np.ndarray:
        return np.pad(leaf, ((0, 0), (0, size - leaf.shape[1])))

    return state.replace(subset=jax.tree.map(padded, state.subset))


def _chunk_ends(step: int, budget: Budget) -> Iterator[int]:
    """Where the chunks after `step` end: after `CHUNK` steps, or at an evaluation."""
    while step < budget.max_steps:
        next_evaluation = (step // budget.evaluate_every + 1) * budget.evaluate_every
        step = min(step + CHUNK, next_evaluation, budget.max_steps)
        yield step


def _untyped(leaf: jax.Array) -> jax.Array:
    """Random keys as their data, which orbax saves as an array."""
    return jax.random.key_data(leaf) if _is_key(leaf) else leaf


def _typed(like: jax.ShapeDtypeStruct, array: jax.Array) -> jax.Array:
    return jax.random.wrap_key_data(array) if _is_key(like) else array


def _is_key(leaf: Any) -> bool:
    return jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key)


@jax.jit
def _take(tree: Any, index: np.ndarray) -> Any:
    return jax.tree.map(lambda leaf: leaf[index], tree)


@jax.jit
def _keep_best(best: Any, best_return: jax.Array, actor: Any, returns: jax.Array):
    better = returns > best_return

    def choose(new: jax.Array, old: jax.Array) -> jax.Array:
        return jnp.where(better.reshape(-1, *(1,) * (new.ndim - 1)), new, old)

    return jax.tree.map(choose, actor, best), jnp.where(better, returns, best_return)


@jax.jit
def _finite(state: TrainingState) -> jax.Array:
    reward = None if state.reward is None else state.reward.params
    trained = (state.agent.actor, state.agent.critic, reward)
    leaves = [
        jnp.isfinite(leaf).reshape(leaf.shape[0], -1).all(axis=1)
        for leaf in jax.tree.leaves(trained)
    ]
    return jnp.stack(leaves).all(axis=0)
