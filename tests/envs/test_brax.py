"""The adapter of brax's tasks, on stand-ins of the same shape."""

from typing import Any

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs, training
from cmedirl_jax.training.methods import METHODS
from tests.support import trainers

KEY = jax.random.key(0)


@flax.struct.dataclass
class State:
    pipeline_state: Any
    obs: jax.Array
    reward: jax.Array
    done: jax.Array
    info: dict[str, Any] = flax.struct.field(default_factory=dict)


class Walk:
    """Walk to 1; `done` is a float, as brax has it."""

    action_size = 2

    def __init__(self, limit=None, resets=False):
        self.limit, self.resets = limit, resets

    def reset(self, rng):
        first, second = jax.random.split(rng)
        position = jax.random.uniform(first, (2,), minval=-0.1, maxval=0.1)
        info = {"rng": second}
        if self.limit is not None:
            info |= {"steps": jnp.zeros(()), "truncation": jnp.zeros(())}
        if self.resets:
            info["first_obs"] = position
        return State(position, position, jnp.zeros(()), jnp.zeros(()), info)

    def step(self, state, action):
        position = state.pipeline_state + 0.1 * action
        done = jnp.where(position[0] >= 1.0, 1.0, 0.0)
        info = dict(state.info)
        if self.limit is not None:
            steps = info["steps"] + 1
            info["truncation"] = jnp.where(steps >= self.limit, 1 - done, 0.0)
            info["steps"] = steps
            done = jnp.where(steps >= self.limit, 1.0, done)
        return State(position, position, -jnp.sum(action**2), done, info)


def ends(env, action):
    state, _ = env.reset(KEY, env.default_params)
    step = jax.jit(env.step)
    for time in range(1, 40):
        state, answer = step(KEY, state, jnp.float32([action, 0.0]), env.default_params)
        if answer.terminated or answer.truncated:
            return time, bool(answer.terminated), bool(answer.truncated)
    raise AssertionError("the episode did not end")


@pytest.mark.parametrize("limit", [None, 30])
def test_termination_and_time_limit_are_told_apart(limit):
    env = envs.from_brax(Walk(limit), max_episode_steps=30)
    envs.check(env)
    time, terminated, truncated = ends(env, 1.0)
    assert 9 <= time <= 11
    assert (terminated, truncated) == (True, False)
    assert ends(env, 0.0) == (30, False, True)


def test_the_wrappers_own_limit_counts_where_it_is_shorter():
    assert ends(envs.from_brax(Walk(12), max_episode_steps=30), 0.0) == (12, False, True)


def test_the_specification_is_of_unbounded_observations():
    spec = envs.from_brax(Walk(), reward_threshold=3.0).spec
    assert (spec.id, spec.observation_dim, spec.action_dim) == ("Walk", 2, 2)
    assert (spec.max_episode_steps, spec.reward_threshold) == (1_000, 3.0)
    assert np.isinf(spec.observation_low).all()
    assert np.isinf(spec.observation_high).all()
    np.testing.assert_array_equal(spec.action_low, [-1, -1])


def test_an_agent_trains_on_it_with_statistics_of_its_observations():
    env = envs.from_brax(Walk(), max_episode_steps=20)
    trainer = training.make(env, METHODS["ddpg"], trainers.SMALL, capacity=80)

    @jax.jit
    def train(key):
        return trainer.run(trainer.init(key, None, 0), None, jnp.arange(80, dtype=jnp.int32))

    state, _ = train(KEY)
    assert int(state.episode) >= 4
    # The first observation, one a step, and the first ones of four more episodes.
    assert float(state.observation_statistics.count) == 85


@pytest.mark.parametrize(
    ("task", "message"),
    [
        (Walk(resets=True), "Walk: it resets by itself"),
        (
            type("Pairs", (), {"reset": lambda self, rng: State(0, {"a": rng}, 0, 0)})(),
            "Pairs: its obs",
        ),
    ],
)
def test_what_is_of_another_shape_is_refused(task, message):
    with pytest.raises(ValueError, match=message):
        envs.from_brax(task)
