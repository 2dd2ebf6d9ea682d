"""Algorithm 2 around a task on the host: the two halves of a step, compiled, and the loop.

One compiled call a step does all that follows from the task's answers and chooses the next actions,
for all seeds. Between two calls numpy steps the task, one sub-environment a seed. Each episode's
start is seeded by the learner's key and the step before it, so that a seed's numbers depend neither
on the others nor on whether it was interrupted between two episodes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import VectorEnv

from cmedirl_jax import compilation, observation_statistics
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.envs import Step, stepping
from cmedirl_jax.training import initialise
from cmedirl_jax.training import step as step_lib
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.step import Behaviour, Log
from cmedirl_jax.training.trainer import Trainer
from cmedirl_jax.types import Numeric, Transition


class Halves(NamedTuple):
    """A trainer's halves of a step over `S` seeds, compiled.

    Attributes:
        behave: `(states, step) -> Behaviour` `[S, ...]`, at step number `step`.
        learn: `(states, (behaviour, answer, next_start), step, pool, max_episodes) ->
            (TrainingState, Log, Behaviour)`: learns from the answers to step number `step`, and
            behaves at the next one. The states are donated.
        first_seeds: `(keys [S]) -> [S] uint32`, of the starts of the learners' first episodes.
        seeds: `(states, step) -> [S] uint32`, of the episodes that begin after step number `step`.
        begin_episode: `((states, observation [S, O]), step) -> TrainingState`: with step number
            `step` an episode begins with that observation; the running one is cut off.
        max_episode_steps: steps after which an episode is cut.
    """

    behave: Callable[[TrainingState, Any], Behaviour]
    learn: Callable[..., tuple[TrainingState, Log, Behaviour]]
    first_seeds: Callable[[jax.Array], jax.Array]
    seeds: Callable[[TrainingState, Any], jax.Array]
    begin_episode: Callable[..., TrainingState]
    max_episode_steps: int


def compile_halves(trainer: Trainer, max_episode_steps: int) -> Halves:
    """Jit a trainer's halves of a step over seeds; they run on the device where the states are."""

    def spread(function: Callable[..., Any]) -> Callable[..., Any]:
        """`function(inputs of a seed, *shared)` over seeds."""

        def mapped(of_seeds: Any, *shared: Any) -> Any:
            in_axes = (0, *(None for _ in shared))
            return jax.vmap(function, in_axes=in_axes)(of_seeds, *shared)

        return mapped

    def behave(state: TrainingState, step: jax.Array) -> Behaviour:
        draws = trainer.draw(state.key, state.subset, step, False)
        return trainer.behave(state, draws, trainer.plan(step))

    def learn(
        inputs: tuple[TrainingState, Behaviour, Step, jax.Array],
        step: jax.Array,
        pool: Transition | None,
        max_episodes: Numeric | None,
    ) -> tuple[TrainingState, Log, Behaviour]:
        state, behaviour, answer, next_start = inputs
        plan = trainer.plan(step)
        demonstrated = plan.learn_reward | (plan.cloning_weight > 0.0)
        draws = trainer.draw(state.key, state.subset, step, demonstrated)
        state, log = trainer.learn(
            state, behaviour, answer, next_start, draws, plan, pool, max_episodes
        )
        return state, log, behave(state, step + 1)

    def first_reset_seed(key: jax.Array) -> jax.Array:
        keys, _ = initialise.split(jax.random.clone(key))
        return jax.random.bits(keys.env, dtype=jnp.uint32)

    def reset_seed(state: TrainingState, step: jax.Array) -> jax.Array:
        return jax.random.bits(step_lib.step_keys(state.key, step)[1], dtype=jnp.uint32)

    def begin_episode(inputs: tuple[TrainingState, jax.Array], step: jax.Array) -> TrainingState:
        return _begin_episode(trainer, *inputs, step)

    learn_all = spread(learn)
    return Halves(
        behave=compilation.jit(spread(behave)),
        learn=compilation.jit(
            lambda states, answered, *shared: learn_all((states, *answered), *shared),
            donate_argnums=0,
        ),
        first_seeds=jax.jit(spread(first_reset_seed)),
        seeds=jax.jit(spread(reset_seed)),
        begin_episode=compilation.jit(spread(begin_episode)),
        max_episode_steps=max_episode_steps,
    )


def _begin_episode(
    trainer: Trainer, state: TrainingState, observation: jax.Array, step: jax.Array
) -> TrainingState:
    sampler, running = state.sampler, state.observation_statistics
    if sampler is not None and trainer.algorithm.sampler is not None:
        sampler = trainer.algorithm.sampler.cut(sampler, step)
    if running is not None:
        # An episode that had just begun was begun with this observation.
        added = observation_statistics.add(running, observation)
        running = step_lib.select(state.episode_length == 0, running, added)
    return state.replace(
        exploration=trainer.algorithm.exploration.reset(state.exploration),
        sampler=sampler,
        observation=observation,
        episode_return=jnp.zeros_like(state.episode_return),
        episode_length=jnp.zeros_like(state.episode_length),
        observation_statistics=running,
    )


def begin(
    halves: Halves,
    trainer: Trainer,
    vector: VectorEnv,
    keys: jax.Array,
    data: HotStartData | None = None,
    n_demonstrations: int = 0,
) -> TrainingState:
    """The seeds before their first step, `[S, ...]`, and the sub-environments with them.

    Args:
        halves: of the trainer.
        trainer: the trainer.
        vector: `S` sub-environments.
        keys: `[S]`, the learners'.
        data: the demonstrations, for methods that use them.
        n_demonstrations: episodes that each learner draws of them.
    """
    first = stepping.reset(vector, np.asarray(halves.first_seeds(keys)))

    def of_seed(key: jax.Array, start: jax.Array) -> TrainingState:
        return trainer.init(key, data, n_demonstrations, None, (None, start))

    return jax.jit(jax.vmap(of_seed))(keys, first)


def run(
    halves: Halves,
    vector: VectorEnv,
    states: TrainingState,
    data: HotStartData | None,
    steps: np.ndarray,
    max_episodes: Numeric | None = None,
) -> tuple[TrainingState, Log]:
    """Take environment steps with every seed.

    Args:
        halves: of the trainer.
        vector: the sub-environments, where the states' `observation` left them.
        states: `[S, ...]`; donated.
        data: the demonstrations, for methods that use them.
        steps: `[T]` int32, the numbers t, t + 1, ... of the steps.
        max_episodes: after so many a seed learns no more.

    Returns:
        The states, and the log `[S, T]` as numpy.
    """
    pool = None if data is None else data.transition
    length = np.array(states.episode_length)
    behaviour, logs = halves.behave(states, steps[0]), []
    for step in steps:
        # The task answers.
        answer = stepping.step(vector, np.asarray(behaviour.action))
        length += 1
        ended = answer.terminated | answer.truncated | (length >= halves.max_episode_steps)
        next_start = answer.observation
        if ended.any():
            numbers = np.asarray(halves.seeds(states, step))
            next_start = stepping.restart(vector, numbers, ended, next_start)
            length[ended] = 0
        # The seeds learn, and act again.
        answered = (behaviour, answer, next_start)
        states, log, behaviour = halves.learn(states, answered, step, pool, max_episodes)
        logs.append(log)
    logs = jax.device_get(logs)
    return states, jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *logs)
