"""Training one cell of the grid: a method, a number of demonstrations, all seeds together."""

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import seeds, training
from cmedirl_jax.envs import Env
from cmedirl_jax.evaluation import Evaluation
from cmedirl_jax.hot_start import HotStartData
from cmedirl_jax.methods import METHODS, Method, Settings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training import Log, TrainingState
from experiments import distributed, judging
from experiments.bookkeeping import Book, Budget, EpisodeRows, EvaluationRows
from experiments.judging import Judge
from experiments.lanes import Lanes

CHUNK = 250
"""Steps per call of the compiled training loop, and so between looks at the seeds from the host."""


class Progress(NamedTuple):
    """Where a cell stands after a chunk: steps taken by each seed, share at the threshold."""

    env_step: int
    solved_fraction: float


class CellResult(NamedTuple):
    """A finished cell.

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


class Programs(NamedTuple):
    """The compiled functions of a method. Every cell of the method uses the same ones.

    Attributes:
        init: `(keys [lanes], groups, data, n_demonstrations) -> TrainingState` `[lanes, ...]`.
        run: `(state, groups, data, steps, max_episodes) -> (TrainingState, Log)`; the state is
            donated. Only the first `groups` groups of lanes on each device move.
        permute: `(state, move [lanes]) -> TrainingState`; lane i takes lane move[i]'s. Donated too.
        judge: noise-free rollouts.
        lanes: how many seeds fit in.
        group: lanes that are stepped together on a device.
        devices: devices that share the lanes.
    """

    init: Callable[..., TrainingState]
    run: Callable[..., tuple[TrainingState, Log]]
    permute: Callable[[TrainingState, np.ndarray], TrainingState]
    judge: Judge
    lanes: int
    group: int
    devices: int


def compile_networks(
    env: Env, architecture: Architecture, group: int, devices: list[jax.Device]
) -> Callable[[jax.Array, int], Any]:
    """Jit the drawing of the networks that every method starts from: `(keys, groups) -> networks`.

    Apart from `compile_method`, because the random numbers are most of what an `init` compiles.
    """
    trainer = training.make(env, METHODS["ddpg"], Settings(architecture), capacity=1)
    drawn = seeds.step_groups(lambda key: (key, trainer.draw_networks(key)), group)

    def draw(keys: jax.Array, groups: int) -> Any:
        return seeds.map_devices(drawn, devices)(keys, groups)[1]

    return jax.jit(draw, out_shardings=seeds.sharding(devices))


def compile_method(
    env: Env,
    method: Method,
    settings: Settings,
    judge: Judge,
    draw_networks: Callable[[jax.Array, int], Any],
    *,
    group: int,
    seeds_count: int,
    devices: list[jax.Device],
    capacity: int,
    subset_size: int | None,
) -> Programs:
    """Jit a method's training, over seeds in groups and over devices. Compiles at first use."""
    trainer = training.make(env, method, settings, capacity=capacity, subset_size=subset_size)

    def spread(function: Callable) -> Callable:
        return seeds.map_devices(seeds.step_groups(function, group), devices)

    def start(
        keys: jax.Array, networks: Any, groups: int, data: HotStartData | None, n_demos: int
    ) -> TrainingState:
        def of_seed(drawn: tuple[jax.Array, Any], *shared: Any):
            key, networks = drawn
            return drawn, trainer.init(key, *shared, networks)

        return spread(of_seed)((keys, networks), groups, data, n_demos)[1]

    def permute(state: TrainingState, move: np.ndarray) -> TrainingState:
        return jax.tree.map(lambda leaf: leaf[move], state)

    # One sharding everywhere: another one, even if equivalent, would compile again.
    split = seeds.sharding(devices)
    start = jax.jit(start, out_shardings=split)

    def init(
        keys: jax.Array, groups: int, data: HotStartData | None, n_demonstrations: int
    ) -> TrainingState:
        return start(keys, draw_networks(keys, groups), groups, data, n_demonstrations)

    return Programs(
        init=init,
        run=jax.jit(spread(trainer.run), donate_argnums=0, out_shardings=split),
        permute=jax.jit(permute, donate_argnums=0, out_shardings=split),
        judge=judge,
        lanes=seeds.padded(seeds_count, group, len(devices)),
        group=group,
        devices=len(devices),
    )


def begin(
    programs: Programs, key: jax.Array, data: HotStartData | None, n_demos: int, seeds_count: int
) -> tuple[Lanes, TrainingState, int]:
    """Initialise a cell's seeds: their lanes, their states, and how many groups hold them."""
    lanes = Lanes(programs.lanes, seeds_count, programs.group, programs.devices)
    groups = lanes.groups(np.ones(seeds_count, bool))
    keys = seeds.keys(key, programs.lanes)[lanes.seed]
    return lanes, programs.init(keys, groups, data, n_demos), groups


def pack(
    programs: Programs, lanes: Lanes, state: TrainingState, active: np.ndarray
) -> tuple[TrainingState, int]:
    """Bring the seeds `active` `[seeds]` to the front; how many groups hold them now."""
    move = lanes.pack(active)
    if move is not None:
        state = programs.permute(state, move)
    return state, lanes.groups(active)


def train(
    programs: Programs,
    key: jax.Array,
    data: HotStartData | None,
    n_demos: int,
    *,
    seeds_count: int,
    budget: Budget,
    threshold: float,
    report: Callable[[Progress], None],
) -> CellResult:
    """Train a cell on `data` (None for a method without demonstrations), reporting each chunk."""
    lanes, state, groups = begin(programs, key, data, n_demos, seeds_count)
    book = Book(seeds_count, budget)

    def of_seeds(tree: Any) -> Any:
        """What lies in lanes, `[lanes, ...]`, as numpy `[seeds, ...]`."""
        index = lanes.of_seed
        return jax.tree.map(lambda leaf: leaf[index], distributed.gather(tree))

    def evaluate(starts: int) -> Evaluation:
        found = programs.judge.on_starts(state.agent.actor, starts, groups)
        return of_seeds(judging.summarise(found))

    found = evaluate(budget.evaluation_starts)
    best, best_return = _take(state.agent.actor, lanes.of_seed), jnp.asarray(found.return_mean)
    book.evaluated("steps", np.arange(seeds_count), found)
    report(Progress(0, book.solved_fraction(threshold)))

    limit = None if budget.max_episodes is None else jnp.int32(budget.max_episodes)
    for start, stop in _chunks(budget.max_steps, budget.evaluate_every):
        active = book.running | (book.pending & ~book.diverged)
        state, groups = pack(programs, lanes, state, active)
        steps = jnp.arange(start, stop, dtype=jnp.int32)
        state, log = programs.run(state, groups, data, steps, limit)
        was_running = book.running.copy()
        finite, log = of_seeds((_finite(state), log))
        book.mark_diverged(finite)
        book.stepped(steps=np.asarray(steps), log=log)
        due = np.flatnonzero(book.due_by_episodes() & ~book.diverged)
        if due.size:
            book.evaluated("episodes", due, evaluate(budget.evaluation_starts_episodes))
        book.pending |= was_running
        over = stop == budget.max_steps or not book.running.any()
        if stop % budget.evaluate_every == 0 or over:
            found = evaluate(budget.evaluation_starts)
            due = np.flatnonzero(book.pending & ~book.diverged)
            book.evaluated("steps", due, found)
            book.pending[:] = False
            returns = np.full(seeds_count, -np.inf, found.return_mean.dtype)
            returns[due] = found.return_mean[due]
            actor = _take(state.agent.actor, lanes.of_seed)
            best, best_return = _keep_best(best, best_return, actor, returns)
        report(Progress(stop, book.solved_fraction(threshold)))
        if over:
            break

    return CellResult(
        evaluations=book.evaluations,
        episodes=book.episode_rows(),
        best=distributed.gather(best),
        reward=None if state.reward is None else of_seeds(state.reward.params),
        env_steps=book.env_step,
        demonstration_steps=np.zeros(seeds_count, np.int32)
        if state.subset is None
        else of_seeds(state.subset.length).sum(axis=1),
        diverged=book.diverged,
        final=of_seeds(state.agent.actor),
    )


def _chunks(max_steps: int, evaluate_every: int) -> Iterator[tuple[int, int]]:
    """Step ranges of at most `CHUNK` that end at every multiple of `evaluate_every`."""
    start = 0
    while start < max_steps:
        next_evaluation = (start // evaluate_every + 1) * evaluate_every
        stop = min(start + CHUNK, next_evaluation, max_steps)
        yield start, stop
        start = stop


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
