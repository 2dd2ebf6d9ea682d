import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.runs.cells import scale
from cmedirl_jax.runs.errors import UserError
from tests.support import pools

PENDULUM = envs.make("Pendulum-v1")


@pytest.fixture
def known_random(monkeypatch):
    """What random actions return where a test is of the demonstrations: to play them compiles."""
    monkeypatch.setattr(scale, "random_return", lambda env, starts: -33.0)
    monkeypatch.setattr(scale, "_random_spread", lambda env: 0.03)


def test_random_actions_return_what_random_episodes_do():
    """On the car without its goal an episode costs 0.1 a^2 a step, on average 1/30."""
    params = pools.ENV.default_params.replace(goal_position=9.0, max_episode_steps=300)
    spec = pools.ENV.spec._replace(max_episode_steps=300)
    env = pools.ENV._replace(spec=spec, default_params=params)
    assert scale.random_return(env, 5) == pytest.approx(-10.0, abs=0.5)


def test_actions_are_drawn_within_their_bounds():
    seen = []

    def step(key, state, action, params):
        seen.append(action)
        return PENDULUM.step(key, state, action, params)

    random_env = scale._with_random_actions(PENDULUM._replace(step=step))
    state, _ = PENDULUM.reset(jax.random.key(0), PENDULUM.default_params)
    for seed in range(200):
        random_env.step(jax.random.key(seed), state, jnp.zeros(1), PENDULUM.default_params)
    drawn = np.array(seen)
    assert np.abs(drawn).max() <= 2.0
    assert np.abs(drawn).max() > 1.9
    assert abs(drawn.mean()) < 0.3


def test_solved_is_nine_tenths_of_the_way_unless_the_task_says():
    assert scale.solved(-100.0, 0.0) == pytest.approx(-10.0)
    pool = pools.scripted(3)
    with_threshold = scale.measure(pools.ENV, pool, 4)
    assert with_threshold.solved == 90.0
    without = pools.ENV._replace(spec=pools.ENV.spec._replace(reward_threshold=None))
    found = scale.measure(without, pool, 4)
    assert found.solved == pytest.approx(found.random + 0.9 * (found.expert - found.random))
    assert found.random < 0 < found.expert


@pytest.mark.usefixtures("known_random")
def test_the_best_expert_is_the_best_that_demonstrates_or_the_mean_of_a_file():
    pool = pools.scripted(3)
    returns = [-3.0, 7.0, 5.0]
    named = pool._replace(metadata=pool.metadata | {"expert_returns": returns})
    assert scale.measure(pools.ENV, named, 2).expert == 7.0
    unnamed = pool._replace(metadata={"env": pools.ENV.spec.id})
    expected = np.add.reduceat(
        np.asarray(pool.transition.reward, float), np.unique(pool.episode, return_index=True)[1]
    ).mean()
    assert scale.measure(pools.ENV, unnamed, 2).expert == pytest.approx(expected)


def test_the_spread_is_of_single_steps():
    found = scale.measure(pools.ENV, pools.scripted(3), 2)
    assert found.reward_spread_demonstrated == pytest.approx(
        np.std(pools.scripted(3).transition.reward)
    )
    # 0.1 a^2 with a uniform has a deviation of 0.03; random actions hardly ever reach the goal.
    assert found.reward_spread_random == pytest.approx(0.03, abs=0.02)


@pytest.mark.usefixtures("known_random")
def test_demonstrations_that_are_no_better_than_random_actions_say_nothing():
    pool = pools.scripted(3)
    env = pools.ENV._replace(spec=pools.ENV.spec._replace(reward_threshold=None))
    worse = pool._replace(metadata=pool.metadata | {"expert_returns": [-500.0]})
    with pytest.raises(UserError, match="--demos: they return -500, random actions -33"):
        scale.measure(env, worse, 2)
    assert scale.measure(pools.ENV, worse, 2).solved == 90.0


@pytest.mark.usefixtures("known_random")
@pytest.mark.parametrize("unknown", [[float("nan")], [None], []])
def test_returns_that_are_not_known_are_those_of_the_episodes(unknown):
    pool = pools.scripted(3)
    unnamed = pool._replace(metadata=pool.metadata | {"expert_returns": unknown})
    assert 90 < scale.measure(pools.ENV, unnamed, 2).expert < 100
