import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.envs import Env, Step
from cmedirl_jax.training import evaluation
from cmedirl_jax.training.evaluation import Rollouts


def bang_bang(observation):
    """Reaches the goal within 180 steps from some starts and not from others."""
    return 0.5 * jnp.where(observation[..., 1:] >= 0, 1.0, -1.0)


@pytest.fixture(scope="module")
def params(env):
    return env.default_params.replace(max_episode_steps=180)


def episode(env, params, state, observation):
    step = jax.jit(env.step)
    rewards, ended = [], False
    while not ended:
        action = bang_bang(observation)
        state, result = step(jax.random.key(0), state, action, params)
        observation = result.observation
        rewards.append(float(result.reward))
        ended = result.terminated or result.truncated
    return sum(rewards), len(rewards), bool(result.terminated)


def test_rollout_is_a_loop_over_steps_for_each_start(env, params):
    states, observations = env.starts(9, params)
    # Some are cut off while others go on, and would reach the goal if they went on too.
    states = states.replace(time=80 * (jnp.arange(9) % 2))
    expected = [
        episode(env, params, jax.tree.map(lambda x, i=i: x[i], states), observations[i])
        for i in range(9)
    ]
    expected_return, expected_length, expected_terminated = zip(*expected, strict=True)
    assert len(set(expected_length)) > 3
    assert set(expected_terminated) == {True, False}

    rollouts = jax.jit(lambda: evaluation.rollout(bang_bang, env, params, (states, observations)))()
    np.testing.assert_allclose(rollouts.episode_return, expected_return, rtol=1e-5)
    np.testing.assert_array_equal(rollouts.length, expected_length)
    np.testing.assert_array_equal(rollouts.terminated, expected_terminated)


def test_the_starts_do_not_influence_each_other(env, params):
    states, observations = env.starts(9, params)
    together = evaluation.rollout(bang_bang, env, params, (states, observations))
    some = jax.tree.map(lambda x: x[2:5], (states, observations))
    apart = evaluation.rollout(bang_bang, env, params, some)
    jax.tree.map(lambda x, y: np.testing.assert_array_equal(x[2:5], y), together, apart)


def test_summary_is_the_statistics_of_the_episodes():
    rollouts = Rollouts(
        episode_return=jnp.array([90.0, -10.0, 94.0]),
        length=jnp.array([70, 999, 66]),
        terminated=jnp.array([True, False, True]),
    )
    summary = evaluation.summarise(rollouts)
    expected = [58.0, np.std([90.0, -10.0, 94.0]), 2 / 3, 1135 / 3]
    np.testing.assert_allclose(summary, expected, rtol=1e-6)


def test_evaluate_summarises_rollouts_from_the_fixed_starts(env, params):
    actual = evaluation.evaluate(bang_bang, env, params, 5)
    expected = evaluation.summarise(
        evaluation.rollout(bang_bang, env, params, env.starts(5, params))
    )
    np.testing.assert_array_equal(actual, expected)


def test_policies_can_be_vmapped_over(env, params):
    def evaluate(gain):
        return evaluation.evaluate(lambda x: gain * bang_bang(x), env, params, 3)

    gains = jnp.array([0.5, 1.0])
    batched = jax.vmap(evaluate)(gains)
    for index, gain in enumerate(gains):
        np.testing.assert_allclose([x[index] for x in batched], evaluate(gain), rtol=1e-5)


def noise(key, time, action, params):
    """Two steps of noise with opposite signs, which cancel if both draw from the same key."""
    reward = jax.random.normal(key) * jnp.where(time == 0, 1.0, -1.0)
    return time + 1, Step(jnp.zeros(1), reward, jnp.bool_(False), time >= 1)


def test_every_step_of_every_start_draws_from_a_key_of_its_own(spec):
    env = Env(spec, None, reset=None, step=noise, starts=None)
    starts = jnp.zeros(4, jnp.int32), jnp.zeros((4, 1))

    def returns(key=None):
        return evaluation.rollout(lambda x: x, env, None, starts, key).episode_return

    np.testing.assert_array_equal(returns(), returns())
    assert len(set(np.asarray(returns()).tolist())) == 4
    assert returns().all()
    assert (returns() != returns(jax.random.key(1))).all()


@pytest.mark.parametrize(
    ("policy", "error", "message"),
    [
        (lambda o: o[:, 0], ValueError, r"actions: expected shape \(3, 1\), got \(3,\)"),
        (lambda o: o, ValueError, r"actions: expected shape \(3, 1\), got \(3, 2\)"),
        (lambda o: o[:1, :1], ValueError, r"actions: expected shape \(3, 1\), got \(1, 1\)"),
        (lambda o: jnp.ones((3, 1), int), TypeError, "actions: expected floats, got int32"),
    ],
)
def test_other_actions_of_a_policy_are_refused(env, params, policy, error, message):
    with pytest.raises(error, match=message):
        evaluation.evaluate(policy, env, params, 3)


def test_an_evaluation_needs_a_start(env, params):
    with pytest.raises(ValueError, match="starts must be at least 1, got 0"):
        evaluation.evaluate(bang_bang, env, params, 0)


def test_an_episode_that_the_task_does_not_end_is_cut_at_the_specifications_limit(env):
    endless = env._replace(
        spec=env.spec._replace(max_episode_steps=30),
        default_params=env.default_params.replace(max_episode_steps=10**6),
    )
    starts = endless.starts(3, endless.default_params)
    rollouts = evaluation.rollout(
        lambda observation: jnp.zeros((3, 1)), endless, endless.default_params, starts
    )
    np.testing.assert_array_equal(rollouts.length, [30, 30, 30])
    assert not rollouts.terminated.any()
