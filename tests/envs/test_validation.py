import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs, training
from cmedirl_jax.envs import Env
from cmedirl_jax.training.methods import METHODS


def stepping(env, **changes):
    """The environment, with changed fields in its `Step`."""

    def step(key, state, action, params):
        state, answer = env.step(key, state, action, params)
        return state, answer._replace(**{name: change(answer) for name, change in changes.items()})

    return env._replace(step=step)


def in_state(env, change):
    """The environment, with a changed state after a step."""

    def step(key, state, action, params):
        state, answer = env.step(key, state, action, params)
        return change(state), answer

    return env._replace(step=step)


def resetting(env, change):
    def reset(key, params):
        state, observation = env.reset(key, params)
        return state, change(observation)

    return env._replace(reset=reset)


def starting(env, change):
    return env._replace(starts=lambda count, params: change(*env.starts(count, params)))


@pytest.mark.parametrize(
    ("spoil", "error", "named"),
    [
        (lambda env: env._replace(spec=env.spec._replace(action_dim=0)), ValueError, "action_dim"),
        (
            lambda env: env._replace(spec=env.spec._replace(max_episode_steps=0)),
            ValueError,
            "max_episode_steps must be at least 1",
        ),
        (
            lambda env: env._replace(spec=env.spec._replace(action_high=env.spec.action_low)),
            ValueError,
            "action_low must be below action_high",
        ),
        (
            lambda env: resetting(env, lambda seen: seen[:1]),
            ValueError,
            r"observation of reset: expected shape \(2,\), got \(1,\)",
        ),
        (
            lambda env: resetting(env, lambda seen: seen.astype(int)),
            TypeError,
            "observation of reset: expected floats, got int32",
        ),
        (
            lambda env: resetting(env, lambda seen: seen.astype(jnp.float16)),
            TypeError,
            "observation of step: is float32, that of reset float16",
        ),
        (
            lambda env: stepping(env, observation=lambda answer: answer.observation[None]),
            ValueError,
            r"observation of step: expected shape \(2,\), got \(1, 2\)",
        ),
        (
            lambda env: stepping(env, reward=lambda answer: answer.observation),
            ValueError,
            r"reward: expected shape \(\), got \(2,\)",
        ),
        (
            lambda env: stepping(env, reward=lambda answer: answer.reward.astype(int)),
            TypeError,
            "reward: expected floats, got int32",
        ),
        (
            lambda env: stepping(env, terminated=lambda answer: answer.terminated * 1.0),
            TypeError,
            "terminated: expected bool, got float32",
        ),
        (
            lambda env: stepping(env, truncated=lambda answer: answer.truncated[None]),
            ValueError,
            r"truncated: expected shape \(\), got \(1,\)",
        ),
        (
            lambda env: in_state(env, lambda state: state.replace(time=state.time * 1.0)),
            ValueError,
            "state after a step is not of reset's kind",
        ),
        (
            lambda env: in_state(env, lambda state: (state, state.time)),
            ValueError,
            "state after a step is not of reset's kind",
        ),
        (
            lambda env: starting(env, lambda states, seen: (states, seen[0])),
            ValueError,
            r"observation of starts: expected shape \(2, 2\), got \(2,\)",
        ),
        (
            lambda env: starting(env, lambda states, seen: (states.position, seen)),
            ValueError,
            "a state of starts is not of reset's kind",
        ),
        (
            lambda env: env._replace(state_at=lambda seen, params: seen),
            ValueError,
            "state_at is not of reset's kind",
        ),
    ],
)
def test_an_environment_that_does_not_keep_to_its_specification_is_refused(
    env, spoil, error, named
):
    spoilt = spoil(env)
    with pytest.raises(error, match=rf"^MountainCarContinuous-v0: .*{named}"):
        envs.check(spoilt)
    with pytest.raises(error, match=named):
        training.make(spoilt, METHODS["ddpg"], capacity=10)
    with pytest.raises(error, match=named):
        training.fit(jax.random.key(0), spoilt, "ddpg", seeds=1, steps=1, evaluate_every=1)


def test_given_parameters_are_checked(env):
    class Params(flax.struct.PyTreeNode):
        goal_reward: jax.Array

    def step(key, state, action, params):
        state, answer = env.step(key, state, action, env.default_params)
        return state, answer._replace(reward=answer.reward + params.goal_reward)

    given = Env(
        env.spec,
        Params(jnp.zeros(())),
        lambda key, params: env.reset(key, env.default_params),
        step,
        lambda count, params: env.starts(count, env.default_params),
    )
    envs.check(given, steps=0)
    with pytest.raises(ValueError, match=r"reward: expected shape \(\), got \(3,\)"):
        envs.check(given, Params(np.zeros(3, np.float32)))


LIMIT = 5


def limited(env, steps):
    """The environment, which truncates after so many steps, whatever its specification says."""
    return env._replace(default_params=env.default_params.replace(max_episode_steps=steps))


@pytest.fixture
def short(env):
    """The environment with a limit of `LIMIT` steps."""
    return limited(env._replace(spec=env.spec._replace(max_episode_steps=LIMIT)), LIMIT)


def test_an_environment_that_keeps_to_its_specification_passes(short):
    envs.check(short)


def at_rest(env):
    """The environment, whose `state_at` forgets the velocity."""
    return env._replace(
        state_at=lambda seen, params: env.state_at(seen * jnp.array([1.0, 0.0]), params)
    )


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (
            lambda env: limited(env, LIMIT + 1),
            "an episode goes on after 5 steps, its specification's max_episode_steps",
        ),
        (
            lambda env: stepping(env, observation=lambda answer: answer.observation + 2.0),
            r"observation\[0\] of step is 1\.[3-6]\d* at step 0, .* keeps it in -1.2 to 0.6",
        ),
        (
            lambda env: stepping(env, observation=lambda answer: answer.observation * jnp.nan),
            r"observation\[0\] of step is nan at step 0",
        ),
        (
            lambda env: stepping(env, reward=lambda answer: answer.reward / 0.0),
            "reward is -inf at step 0",
        ),
        (
            lambda env: resetting(env, lambda seen: seen - jnp.array([0.0, 0.1])),
            r"observation\[1\] of reset is -0.1 at step 0, its .* keeps it in -0.07 to 0.07",
        ),
        (
            lambda env: starting(env, lambda states, seen: (states, seen * jnp.inf)),
            r"observation\[0\] of starts is -inf at step 0",
        ),
        (
            at_rest,
            r"observation of step 1 is -0.\d+, from state_at of the observation before -0.",
        ),
    ],
)
def test_an_environment_that_breaks_its_specification_in_play_is_refused(short, spoil, message):
    spoilt = spoil(short)
    envs.check(spoilt, steps=0)
    with pytest.raises(ValueError, match=rf"^MountainCarContinuous-v0: {message}"):
        envs.check(spoilt)


def test_what_a_task_answers_after_an_episodes_end_is_not_asked(short):
    def step(key, state, action, params):
        state, answer = short.step(key, state, action, params)
        return state, answer._replace(
            reward=jnp.where(state.time > 3, jnp.nan, answer.reward), truncated=state.time >= 3
        )

    envs.check(short._replace(step=step))


def test_a_program_that_asks_for_equal_ranks_can_check_its_task(short):
    with jax.numpy_rank_promotion("raise"):
        envs.check(short)
