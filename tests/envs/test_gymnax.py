"""The adapter of gymnax's tasks, on stand-ins of the same shape."""

import types

import chex
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
    position: jax.Array
    time: int


@flax.struct.dataclass
class Params:
    push: float = 0.1
    max_steps_in_episode: int = 30


class Walk:
    """Walk to 1 within 30 steps; written as gymnax's tasks are, loose types included."""

    name = "Walk-v0"
    default_params = Params()

    def reset_env(self, key, params):
        # A Python integer, as gymnax has it.
        state = State(position=jax.random.uniform(key, minval=-0.1, maxval=0.1), time=0)
        return self.get_obs(state), state

    def step_env(self, key, state, action, params):
        position = state.position + params.push * jnp.clip(action, -1, 1).squeeze()
        state = State(position=position, time=state.time + 1)
        done = self.is_terminal(state, params)
        return self.get_obs(state), state, -0.5, done, {"discount": 1.0}

    def get_obs(self, state):
        return jnp.array([state.position, 1.0])

    def is_terminal(self, state, params):
        return jnp.logical_or(state.position >= 1.0, state.time >= params.max_steps_in_episode)

    def observation_space(self, params):
        return types.SimpleNamespace(low=np.array([-4, 0]), high=np.array([4, 1]), shape=(2,))

    def action_space(self, params):
        return types.SimpleNamespace(low=-1.0, high=1.0, shape=(1,))


def test_it_keeps_to_its_specification():
    env = envs.from_gymnax(Walk())
    envs.check(env)
    assert env.spec.id == "Walk-v0"
    assert env.spec.max_episode_steps == 30
    assert env.spec.reward_threshold is None
    np.testing.assert_array_equal(env.spec.observation_low, np.float32([-4, 0]))
    np.testing.assert_array_equal(env.spec.action_high, np.float32([1]))


def ends(env, action):
    state, _ = env.reset(KEY, env.default_params)
    step = jax.jit(env.step)
    for time in range(1, 40):
        state, answer = step(KEY, state, jnp.float32([action]), env.default_params)
        if answer.terminated or answer.truncated:
            return time, bool(answer.terminated), bool(answer.truncated)
    raise AssertionError("the episode did not end")


def test_termination_and_time_limit_are_told_apart():
    env = envs.from_gymnax(Walk())
    time, terminated, truncated = ends(env, 1.0)
    assert 9 <= time <= 11
    assert (terminated, truncated) == (True, False)
    assert ends(env, 0.0) == (30, False, True)


def test_an_end_that_depends_on_the_time_is_one_before_the_limit():
    class Hurry(Walk):
        def is_terminal(self, state, params):
            late = jnp.logical_and(state.time >= 10, state.position < 0.5)
            return jnp.logical_or(super().is_terminal(state, params), late)

    assert ends(envs.from_gymnax(Hurry()), 0.0) == (10, True, False)


def test_parameters_are_traced_and_can_be_given():
    env = envs.from_gymnax(Walk(), Params(push=0.2), id="Fast-v0", reward_threshold=-4.0)
    assert (env.spec.id, env.spec.reward_threshold) == ("Fast-v0", -4.0)
    assert 4 <= ends(env, 1.0)[0] <= 6

    def moved(push):
        state, before = env.reset(KEY, env.default_params)
        params = env.default_params.replace(push=push)
        return env.step(KEY, state, jnp.ones(1), params)[1].observation[0] - before[0]

    pushes = np.float32([0.1, 0.4])
    np.testing.assert_allclose(jax.jit(jax.vmap(moved))(pushes), pushes, rtol=1e-5)


def test_starts_are_fixed():
    env = envs.from_gymnax(Walk())
    chex.assert_trees_all_equal(
        env.starts(4, env.default_params), env.starts(4, env.default_params)
    )


def test_an_agent_trains_on_it():
    env = envs.from_gymnax(Walk())
    trainer = training.make(env, METHODS["ddpg"], trainers.SMALL, capacity=80)

    @jax.jit
    def train(key):
        return trainer.run(trainer.init(key, None, 0), None, jnp.arange(80, dtype=jnp.int32))

    state, log = jax.device_get(train(KEY))
    assert int(state.episode) >= 2
    np.testing.assert_allclose(log.episode_return[log.done], -0.5 * log.episode_length[log.done])


@pytest.mark.parametrize(
    ("space", "changed", "message"),
    [
        ("action_space", types.SimpleNamespace(n=3), "its actions are SimpleNamespace, not cont"),
        (
            "observation_space",
            types.SimpleNamespace(low=0, high=1, shape=(3, 3)),
            r"its observations have shape \(3, 3\), not one axis",
        ),
    ],
)
def test_other_spaces_are_refused(space, changed, message):
    task = Walk()
    setattr(task, space, lambda params: changed)
    with pytest.raises(ValueError, match=message):
        envs.from_gymnax(task)
