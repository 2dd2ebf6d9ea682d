"""Training many seeds on a task of the host, and evaluating them as they go.

    task = envs.from_gymnasium("InvertedPendulum-v5")
    result = training.host.fit(key, task, "hs-me-ddpg", demonstrations, seeds=8, steps=10_000)

What it runs in JAX it compiles itself: a task on the host cannot be within the caller's program.
"""

import contextlib

import jax
import numpy as np

from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import HostEnv
from cmedirl_jax.training import evaluation, host_loop
from cmedirl_jax.training import seeds as seeds_lib
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.fit import Result, prepare
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.training.trainer import make


def fit(
    key: jax.Array,
    env: HostEnv,
    method: Method | str,
    demonstrations: Demonstrations | None = None,
    *,
    seeds: int,
    steps: int,
    n_demonstrations: int | None = None,
    settings: Settings | None = None,
    evaluate_every: int = 250,
    evaluation_starts: int = 10,
) -> Result:
    """`training.fit` for a task on the host: one sub-environment a seed. It is not jittable.

    The evaluation starts are those of the reset seeds 0, 1, ...

    Args:
        key: seed i learns from `fold_in(key, i)`.
        env: the task.
        method: a `Method`, or the name of one of `METHODS`.
        demonstrations: the pool, for methods that use one.
        seeds: how many learners.
        steps: environment steps of each; a multiple of `evaluate_every`.
        n_demonstrations: episodes that each learner draws from the pool; default all.
        settings: every other choice.
        evaluate_every: steps between evaluations.
        evaluation_starts: start states per evaluation.

    Raises:
        ValueError: as `training.fit`, whose task is one in JAX; and for a method with a tabular
            reward.
    """
    prepared = prepare(
        env.spec,
        method,
        demonstrations,
        n_demonstrations,
        settings,
        seeds=seeds,
        steps=steps,
        evaluate_every=evaluate_every,
        evaluation_starts=evaluation_starts,
    )
    trainer = make(env, prepared.method, prepared.settings, capacity=steps)
    halves = host_loop.compile_halves(trainer, env.spec.max_episode_steps)
    act = jax.jit(jax.vmap(trainer.act))
    summarise = jax.jit(jax.vmap(evaluation.summarise))
    starts = np.arange(evaluation_starts)

    with (
        contextlib.closing(env.vector(seeds)) as vector,
        contextlib.closing(env.vector(seeds)) as evaluating,
    ):

        def evaluate(states: TrainingState) -> Evaluation:
            actor = states.agent.actor
            return summarise(
                evaluation.rollout_on_host(
                    lambda seen: act(actor, seen), evaluating, starts, env.spec.max_episode_steps
                )
            )

        keys = seeds_lib.keys(key, seeds)
        states = host_loop.begin(
            halves, trainer, vector, keys, prepared.data, prepared.n_demonstrations
        )
        evaluations, logs = [evaluate(states)], []
        for chunk in np.arange(steps, dtype=np.int32).reshape(-1, evaluate_every):
            states, log = host_loop.run(halves, vector, states, prepared.data, chunk)
            evaluations.append(evaluate(states))
            logs.append(log)
    return Result(
        states,
        jax.tree.map(lambda *leaves: np.stack(leaves, axis=1), *evaluations),
        jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *logs),
    )
