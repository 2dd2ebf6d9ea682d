"""Training many seeds and evaluating them as they go, in one call."""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import checks
from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.training import evaluation, needs
from cmedirl_jax.training import seeds as seeds_lib
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.training.step import Log
from cmedirl_jax.training.trainer import Trainer, make
from cmedirl_jax.types import EnvSpec


class Result(NamedTuple):
    """What `fit` returns, every leaf with a leading axis of seeds.

    Attributes:
        states: the final training states `[seeds, ...]`.
        evaluations: `[seeds, 1 + steps // evaluate_every]`, the first before any step.
        episodes: the step-wise log `[seeds, steps]`.
    """

    states: TrainingState
    evaluations: Evaluation
    episodes: Log


class Prepared(NamedTuple):
    """What a call of `fit` asks for, checked.

    Attributes:
        method: the method.
        settings: every other choice.
        data: the demonstrations; None for a method without.
        n_demonstrations: episodes that each learner draws.
    """

    method: Method
    settings: Settings
    data: HotStartData | None
    n_demonstrations: int


def prepare(
    spec: EnvSpec,
    method: Method | str,
    demonstrations: Demonstrations | None,
    n_demonstrations: int | None,
    settings: Settings | None,
    *,
    seeds: int,
    steps: int,
    evaluate_every: int,
    evaluation_starts: int,
) -> Prepared:
    """Check the arguments of `fit`, which describes them."""
    if isinstance(method, str):
        method = METHODS[method]
    checks.sizes(
        seeds=seeds,
        steps=steps,
        evaluate_every=evaluate_every,
        evaluation_starts=evaluation_starts,
    )
    if steps % evaluate_every:
        raise ValueError(f"steps ({steps}) must be a multiple of evaluate_every ({evaluate_every})")
    settings = settings or Settings()
    data, n = None, 0
    if demonstrations is not None and method.uses_demonstrations:
        demonstrations_lib.validate(demonstrations, spec)
        needs.check(method, settings, demonstrations_lib.absent(demonstrations))
        agent = settings.agent
        data = hot_start.data(demonstrations, agent.discount, agent.reward_scale)
        n = len(data.episodes.start) if n_demonstrations is None else n_demonstrations
    return Prepared(method, settings, data, n)


def fit(
    key: jax.Array,
    env: Env,
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
    """Train `seeds` independent learners and evaluate them as they go. Jittable; jits nothing.

    Args:
        key: seed i learns from `fold_in(key, i)`.
        env: the environment.
        method: a `Method`, or the name of one of `METHODS`.
        demonstrations: the pool, for methods that use one.
        seeds: how many learners.
        steps: environment steps of each; a multiple of `evaluate_every`.
        n_demonstrations: episodes that each learner draws from the pool; default all.
        settings: every other choice.
        evaluate_every: steps between evaluations.
        evaluation_starts: start states per evaluation.

    Raises:
        ValueError: for a task on the host, an unknown method, missing demonstrations or some that
            are not valid for the environment, sizes that are not positive, `steps` that are no
            multiple of `evaluate_every`, or what `make` refuses.
    """
    if isinstance(env, HostEnv):
        raise ValueError(f"{env.spec.id} is stepped on the host: use training.host.fit")
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

    def learn(key: jax.Array) -> Result:
        state = trainer.init(key, prepared.data, prepared.n_demonstrations)
        return learn_and_evaluate(
            trainer,
            state,
            prepared.data,
            env,
            env.default_params,
            steps=steps,
            evaluate_every=evaluate_every,
            evaluation_starts=evaluation_starts,
        )

    group = seeds_lib.group_size(seeds, hidden=prepared.settings.architecture.hidden)
    keys = seeds_lib.keys(key, seeds_lib.padded(seeds, group))
    result = seeds_lib.map_groups(learn, group)(keys)
    return jax.tree.map(lambda x: x[:seeds], result)


def learn_and_evaluate(
    trainer: Trainer,
    state: TrainingState,
    data: HotStartData | None,
    env: Env,
    params: Any,
    *,
    steps: int,
    evaluate_every: int,
    evaluation_starts: int,
) -> Result:
    """Train one seed from its first state, and evaluate it as it goes: leaves without seeds.

    Args:
        trainer: the method on its environment.
        state: what its `init` gave.
        data: the demonstrations; None for a method without.
        env: the environment to evaluate in.
        params: its parameters.
        steps: environment steps; a multiple of `evaluate_every`.
        evaluate_every: steps between evaluations.
        evaluation_starts: start states per evaluation.
    """

    def evaluate(state: TrainingState) -> Evaluation:
        return evaluation.evaluate(
            lambda observation: trainer.act(state.agent.actor, observation),
            env,
            params,
            evaluation_starts,
        )

    def chunk(state: TrainingState, steps: jax.Array):
        state, log = trainer.run(state, data, steps)
        return state, (evaluate(state), log)

    first = evaluate(state)
    chunks = jnp.arange(steps, dtype=jnp.int32).reshape(-1, evaluate_every)
    state, (later, log) = jax.lax.scan(chunk, state, chunks)
    evaluations = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), first, later)
    return Result(state, evaluations, jax.tree.map(lambda x: x.reshape(steps), log))
