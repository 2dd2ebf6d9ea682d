import dataclasses
import functools
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.agents import hot_start
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.tabular import discretise, imitation
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.tabular.interpolation import Grid, points
from cmedirl_jax.training import evaluation
from tests.support import pools
from tests.support.compiling import jit_as_users

SMALL = TabularSettings(states=11, actions=3, steps=3, centres=3, hidden=(8,))


@pytest.fixture(scope="module")
def data():
    return hot_start.data(pools.scripted())


@pytest.fixture(scope="module")
def mdp():
    return jax.jit(lambda: imitation.discretised(pools.ENV, SMALL))()


@pytest.mark.parametrize("chosen", [None, [2], [0, 3, 1]])
def test_visitation_counts_discounted_steps_where_they_were(data, mdp, chosen):
    """A loop over the chosen demonstrations; their mean place and action are kept."""
    pool = data.episodes
    which = range(len(pool.start)) if chosen is None else chosen
    subset = None
    if chosen is not None:
        # With padding, as for a traced number of demonstrations.
        start = np.append(np.asarray(pool.start)[chosen], pool.start[1])
        length = np.append(np.asarray(pool.length)[chosen], 0)
        subset = DemonstrationSubset(jnp.asarray(start), jnp.asarray(length))
    count = jax.jit(lambda subset: imitation.visitation(mdp, data, subset, discount=0.9))
    counted = jax.device_get(count(subset))
    total, place, action, first = 0.0, np.zeros(2), np.zeros(1), np.zeros(2)
    for episode in which:
        begin, steps = int(pool.start[episode]), int(pool.length[episode])
        weight = 0.9 ** np.arange(steps) / len(which)
        rows = slice(begin, begin + steps)
        total += weight.sum()
        place += weight @ data.transition.observation[rows]
        action += weight @ data.transition.action[rows]
        first += data.transition.observation[begin] / len(which)
    grid, levels = points(mdp.states), points(mdp.actions)
    visits = np.asarray(counted.visitation)
    np.testing.assert_allclose(visits.sum(), total, rtol=1e-5)
    np.testing.assert_allclose(visits[:-1].sum(1) @ grid, place, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(visits.sum(0) @ levels, action, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(counted.initial[:-1] @ grid, first, rtol=1e-4, atol=1e-5)
    assert (visits >= 0).all()
    assert (visits[-1] == 0).all()


@pytest.mark.parametrize("block", [slice(0, 2), slice(5, 7), slice(10, 12)])
def test_steps_of_episodes_that_are_not_the_learners_count_nothing(data, mdp, block):
    own = DemonstrationSubset(*(np.asarray(leaf)[block] for leaf in data.episodes))
    # So many steps lie before and after that a discount to their power is 0 or infinite.
    assert data.transition.reward.size > 10 * 126
    count = functools.partial(imitation.visitation, mdp, discount=0.5)
    both = jax.jit(lambda: (count(data._replace(episodes=own), own), count(data, own)))
    mine, subset = both()
    for actual, expected in zip(mine[:2], subset[:2], strict=True):
        assert np.isfinite(actual).all()
        np.testing.assert_allclose(actual, expected, rtol=1e-6)
        assert np.asarray(actual).sum() > 0.9


@pytest.mark.parametrize(
    ("start", "length", "message"),
    [
        ([0], [3], "the pool has no episode of 3 steps from step 0"),
        ([1], [90], "the pool has no episode of 90 steps from step 1"),
        ([-1], [90], "subset.start must be at least 0, got -1"),
        ([0], [0], "subset.length: expected a positive one"),
    ],
)
def test_episodes_that_the_pool_does_not_have_are_refused(data, mdp, start, length, message):
    subset = DemonstrationSubset(np.array(start), np.array(length))
    with pytest.raises(ValueError, match=message):
        imitation.visitation(mdp, data, subset, discount=0.9)
    with pytest.raises(ValueError, match=message):
        imitation.fit(jax.random.key(0), mdp, pools.ENV.spec, data, subset, kind="linear")


@pytest.mark.parametrize("reward", ["state", "state-action"])
@pytest.mark.parametrize("kind", ["linear", "deep"])
def test_every_reward_is_fitted_and_vmaps(data, mdp, kind, reward):
    settings = dataclasses.replace(SMALL, reward=reward)

    def fit(key, mdp, data):
        subset_key, key = jax.random.split(key)
        subset = demonstrations.subset(subset_key, data.episodes, 2)
        return imitation.fit(key, mdp, pools.ENV.spec, data, subset, kind=kind, settings=settings)

    keys = jax.random.split(jax.random.key(0), 2)
    result = jax.jit(jax.vmap(fit, in_axes=(0, None, None)))(keys, mdp, data)
    assert result.reward.shape == (2, 122, 3)
    spread = np.ptp(np.asarray(result.reward), axis=2).max()
    assert spread == 0 if reward == "state" else spread > 1e-4
    error = result.info.visitation_error
    assert (error[:, -1] < error[:, 0]).all()
    assert (np.asarray(result.reward[0]) != np.asarray(result.reward[1])).any()


@pytest.mark.optimised
@pytest.mark.parametrize("kind", ["linear", pytest.param("deep", marks=pytest.mark.slow)])
def test_the_reward_of_twelve_demonstrations_solves_the_task(kind):
    """The greedy policy and the soft one, from each of 20 start states."""
    settings = TabularSettings()
    env, params = pools.ENV, pools.ENV.default_params
    data = hot_start.data(pools.scripted(push=0.6))

    @jit_as_users
    def returns(data):
        mdp = imitation.discretised(env, settings)
        result = imitation.fit(jax.random.key(0), mdp, env.spec, data, kind=kind, settings=settings)
        starts = env.starts(20, params)
        greedy = discretise.greedy(mdp, result.policy.action_values)
        soft = discretise.sampled(mdp, env)
        return [
            evaluation.rollout(greedy, env, params, starts).episode_return,
            evaluation.rollout(
                lambda o: discretise.look_up(mdp, result.policy.log_probabilities, o),
                soft,
                params,
                starts,
            ).episode_return,
        ]

    greedy, soft = returns(data)
    assert greedy.min() > 90
    assert soft.min() > 90


def test_what_is_a_power_of_the_dimensions_is_refused_before_it_is_made(data):
    def widened(observations, actions):
        return pools.ENV.spec._replace(
            observation_dim=observations,
            observation_low=np.zeros(observations, np.float32),
            observation_high=np.ones(observations, np.float32),
            action_dim=actions,
            action_low=np.zeros(actions, np.float32),
            action_high=np.ones(actions, np.float32),
        )

    # Grids of 41 and 7 points, 9 centres, 64 units.
    for dims, kind, size in (((3, 1), "linear", "1.06e+9"), ((4, 1), "deep", "1.27e+9")):
        with pytest.raises(ValueError, match=re.escape(f"[S, A, F] would be {size} numbers")):
            imitation.check(widened(*dims), kind, TabularSettings())
        imitation.check(widened(2, 1), kind, TabularSettings())
    env = pools.ENV._replace(spec=widened(4, 1))
    with pytest.raises(ValueError, match=re.escape("successors] would be 3.16e+8 numbers")):
        imitation.discretised(env)

    # 2,959 steps, each shared among 2^8 states and 2^9 actions.
    states, actions = (Grid((0.0,) * dims, (1.0,) * dims, (2,) * dims) for dims in (8, 9))
    mdp = discretise.FiniteMDP(None, None, None, states, actions)
    with pytest.raises(ValueError, match=re.escape("2^A] would be 3.88e+8 numbers")):
        imitation.visitation(mdp, data, discount=0.9)
