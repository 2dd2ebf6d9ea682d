"""The two halves of a step, called by a host that steps the task itself."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from tests.support.trainers import ENV, LIMIT, data, start

STEPS = LIMIT + 15


@pytest.mark.parametrize("method", ["ddpg", "hs-me-ddpg"])
def test_a_host_that_calls_the_halves_learns_what_run_learns(method):
    trainer, before, advance = start(method)
    pool = None if before.subset is None else data().transition
    expected, expected_log = advance(before, 0, STEPS)
    draw, plan, behave, learn = map(
        jax.jit, (trainer.draw, trainer.plan, trainer.behave, trainer.learn)
    )
    step_env, reset = jax.jit(ENV.step), jax.jit(ENV.reset)
    state, log = before.replace(env=None), []
    task = before.env
    for number in range(STEPS):
        # The keys of the task's own randomness are those that `run` uses.
        env_key, reset_key, *_ = jax.random.split(jax.random.fold_in(before.key, number), 4)
        draws, now = draw(before.key, before.subset, number), plan(number)
        behaviour = behave(state, draws, now)
        task, answer = step_env(env_key, task, behaviour.action, ENV.default_params)
        first_state, first_observation = reset(reset_key, ENV.default_params)
        if answer.terminated or answer.truncated:
            task = first_state
        state, entry = learn(state, behaviour, answer, first_observation, draws, now, pool)
        log.append(entry)
    assert state.env is None
    assert state.episode == 1
    np.testing.assert_array_equal([entry.done for entry in log], expected_log.done)
    close = {"rtol": 1e-3, "atol": 1e-4}
    chex.assert_trees_all_close(state.agent.actor, expected.agent.actor, **close)
    chex.assert_trees_all_close(state.agent.critic, expected.agent.critic, **close)
    chex.assert_trees_all_close(state.reward, expected.reward, **close)
    chex.assert_trees_all_close(state.observation, expected.observation, **close)


def test_an_episode_that_ends_goes_on_from_the_start_it_is_given():
    trainer, state, _ = start("ddpg")
    draws, plan = trainer.draw(state.key, state.subset, jnp.int32(0)), trainer.plan(jnp.int32(0))
    behaviour = trainer.behave(state, draws, plan)
    _, answer = ENV.step(jax.random.key(0), state.env, behaviour.action, ENV.default_params)
    given = jnp.array([-0.4, 0.0])
    for ended, observation in ((False, answer.observation), (True, given)):
        answered = answer._replace(truncated=jnp.asarray(ended))
        after, log = trainer.learn(state, behaviour, answered, given, draws, plan, None)
        np.testing.assert_array_equal(after.observation, observation)
        # The replay holds the true successor in both cases.
        np.testing.assert_array_equal(after.storage[0, 4:6], answer.observation)
        assert log.done == ended
        assert after.episode_length == (0 if ended else 1)
