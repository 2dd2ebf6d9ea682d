"""Where the returns of a task lie: from those of random actions to those of the best expert.

A task whose specification has no `reward_threshold` counts as solved at `SOLVED` of the way. Both
ends are measured on the evaluation starts. The spread of the rewards of single steps says how large
a learned reward has to be to matter beside the task's own.
"""

import contextlib
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv, Step, playing
from cmedirl_jax.runs.cells import recording
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.training import evaluation

SOLVED = 0.9
"""The share of the way at which a task counts as solved."""
ROUNDS = 10
"""Random episodes from each evaluation start."""
EPISODES = 100
"""Random episodes from fresh starts, for the spread of a step's reward."""


class Scale(NamedTuple):
    """The returns of a task, undiscounted means over the evaluation starts, and its rewards.

    Attributes:
        random: return of actions that are drawn uniformly within their bounds.
        expert: return of the best expert that demonstrates; None where no rewards are known.
        solved: the return that counts as solved: the task's own, where it has one.
        reward_spread_random: standard deviation of a step's reward, over random episodes.
        reward_spread_demonstrated: the same, over the demonstrations; None without rewards.
    """

    random: float
    expert: float | None
    solved: float
    reward_spread_random: float
    reward_spread_demonstrated: float | None


def measure(env: Env | HostEnv, pool: Demonstrations, starts: int) -> Scale:
    """The scale of a task by its demonstrations.

    Args:
        env: the task.
        pool: whose metadata name the `expert_returns`; else the mean return of its episodes stands
            for the best expert's.
        starts: the number of evaluation starts.

    Raises:
        UserError: if the task has no threshold, and the best expert is no better than random
            actions.
    """
    named = np.array(pool.metadata.get("expert_returns", []), float)
    known = "reward" not in demonstrations_lib.absent(pool)
    expert = float(np.nanmax(named)) if np.isfinite(named).any() else None
    if expert is None and known:
        expert = float(demonstrations_lib.returns(pool).mean())
    if isinstance(env, HostEnv):
        random, spread = _random_on_host(env, starts)
    else:
        random, spread = random_return(env, starts), _random_spread(env)
    threshold = env.spec.reward_threshold
    if threshold is None and (expert is None or not expert > random):
        returned = "have no rewards" if expert is None else f"return {expert:.4g}"
        raise UserError(
            f"--demos: they {returned}, random actions {random:.4g}: nothing says what "
            f"counts as solved in {env.spec.id}"
        )
    return Scale(
        random=random,
        expert=expert,
        solved=threshold if threshold is not None else solved(random, expert or random),
        reward_spread_random=spread,
        reward_spread_demonstrated=float(np.std(pool.transition.reward)) if known else None,
    )


def solved(random: float, expert: float) -> float:
    """The return at `SOLVED` of the way from random actions to the expert."""
    return random + SOLVED * (expert - random)


def random_return(env: Env | HostEnv, starts: int) -> float:
    """The mean return of random actions from the evaluation starts."""
    if isinstance(env, HostEnv):
        return _random_on_host(env, starts)[0]
    random_env, params = _with_random_actions(env), env.default_params

    @jax.jit
    def run(key: jax.Array) -> jax.Array:
        return evaluation.rollout(
            lambda observations: jnp.zeros((starts, env.spec.action_dim)),
            random_env,
            params,
            env.starts(starts, params),
            key,
        ).episode_return

    return float(np.mean([run(key) for key in jax.random.split(jax.random.key(0), ROUNDS)]))


def _random_on_host(env: HostEnv, starts: int) -> tuple[float, float]:
    """The mean return of random actions, and the standard deviation of a step's reward."""
    spec, generator = env.spec, np.random.default_rng(0)
    # Sub-environment i plays from every `ROUNDS`-th start; processes of their own are many.
    seeds = np.tile(np.arange(starts), ROUNDS).reshape(-1, ROUNDS).T

    def act(observations: np.ndarray) -> np.ndarray:
        shape = (len(observations), spec.action_dim)
        return generator.uniform(spec.action_low, spec.action_high, shape)

    with contextlib.closing(env.vector(ROUNDS)) as vector:
        rewards = np.concatenate(
            [
                played.answer.reward[played.playing]
                for played in playing.play(vector, act, seeds, spec.max_episode_steps)
            ]
        )
    return float(rewards.sum() / seeds.size), float(np.std(rewards))


def _random_spread(env: Env) -> float:
    def act(actor: None, observations: jax.Array) -> jax.Array:
        del actor
        return jnp.zeros((*observations.shape[:-1], env.spec.action_dim))

    random_env = _with_random_actions(env)
    record = jax.jit(lambda key: recording.record(act, random_env, None, key, EPISODES))
    transition, running, _ = jax.device_get(record(jax.random.key(1)))
    return float(np.std(transition.reward[running]))


def _with_random_actions(env: Env) -> Env:
    """The task with an action that it draws uniformly in place of the one that it is given."""
    spec = env.spec

    def step(key: jax.Array, state: Any, action: jax.Array, params: Any) -> tuple[Any, Step]:
        del action
        draw_key, step_key = jax.random.split(key)
        drawn = jax.random.uniform(
            draw_key, (spec.action_dim,), jnp.float32, spec.action_low, spec.action_high
        )
        return env.step(step_key, state, drawn, params)

    return env._replace(step=step)
