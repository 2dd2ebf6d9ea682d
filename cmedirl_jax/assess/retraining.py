"""How fresh agents fare on frozen rewards alone, and under other physics.

The environment's own reward is not seen in training; it only judges.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.envs import Env
from cmedirl_jax.envs.with_reward import PayingParams, with_reward
from cmedirl_jax.training import seeds as seeds_lib
from cmedirl_jax.training import trainer
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.fit import learn_and_evaluate, prepare
from cmedirl_jax.training.settings import Settings


class _Learner(NamedTuple):
    """What one agent learns from.

    Attributes:
        key: its randomness.
        reward: parameters of its reward.
        physics: parameters of its environment.
    """

    key: jax.Array
    reward: Any
    physics: Any


def retrain(
    keys: jax.Array,
    env: Env,
    rewards: Rewards | None,
    physics: Any = None,
    *,
    steps: int,
    settings: Settings | None = None,
    evaluate_every: int = 1_000,
    evaluation_starts: int = 10,
) -> Evaluation:
    """Train a fresh DDPG on each reward, and evaluate it by the environment's own.

    Agents of equal keys have the same networks, starts and noise, so that different rewards can be
    compared in pairs. Jittable; jits nothing.

    Args:
        keys: `[R]`, of each agent.
        env: the environment.
        rewards: `R` rewards, which do not learn on; None: the environment's own, the same for all.
        physics: the environment's parameters, leaves `[P, ...]`: each reward is tried under each;
            default `env.default_params` alone, `P = 1`.
        steps: environment steps of each agent; a multiple of `evaluate_every`.
        settings: of the agent; those of the reward are not read.
        evaluate_every: steps between evaluations.
        evaluation_starts: start states per evaluation.

    Returns:
        Leaves `[R, P, 1 + steps // evaluate_every]`, the first before any step.

    Raises:
        ValueError: for sizes that are not positive, or `steps` that are no multiple of
            `evaluate_every`.
    """
    budget = {"steps": steps, "evaluate_every": evaluate_every}
    budget["evaluation_starts"] = evaluation_starts
    prepared = prepare(env.spec, "ddpg", None, None, settings, seeds=keys.shape[0], **budget)
    if physics is None:
        physics = jax.tree.map(lambda leaf: jnp.asarray(leaf)[None], env.default_params)
    paying = env if rewards is None else with_reward(env, rewards.reward)

    def learn(learner: _Learner) -> Evaluation:
        params = learner.physics
        if rewards is not None:
            params = PayingParams(params, learner.reward)
        made = trainer.make(
            paying, prepared.method, prepared.settings, capacity=steps, env_params=params
        )
        state = made.init(learner.key, None, 0)
        return learn_and_evaluate(made, state, None, env, learner.physics, **budget).evaluations

    # Every reward under every physics, in groups that fit the cache.
    leaves = jax.tree.leaves(physics)
    # A task may have no parameters.
    worlds = leaves[0].shape[0] if leaves else 1
    count = keys.shape[0] * worlds
    group = seeds_lib.group_size(count, hidden=prepared.settings.architecture.hidden)
    which = jnp.arange(seeds_lib.padded(count, group)) % count
    agent, world = which // worlds, which % worlds
    learners = _Learner(
        keys[agent],
        jax.tree.map(
            lambda leaf: jnp.asarray(leaf)[agent], () if rewards is None else rewards.params
        ),
        jax.tree.map(lambda leaf: jnp.asarray(leaf)[world], physics),
    )
    found = seeds_lib.map_groups(learn, group)(learners)
    return jax.tree.map(lambda leaf: leaf[:count].reshape(-1, worlds, *leaf.shape[1:]), found)
