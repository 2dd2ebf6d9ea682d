"""Distances between rewards against slow references in float64, and on rewards that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax.assess import coverage as coverage_lib
from cmedirl_jax.assess import distances
from cmedirl_jax.assess.distances import Coverage
from tests.support import mdps, pools

DISCOUNT = 0.9
UNRELATED = 1 / np.sqrt(2)


def follow(observation, action):
    """A task whose observation decays and is pushed."""
    return 0.9 * observation + jnp.pad(action, (0, observation.shape[-1] - action.shape[-1]))


def covered(seed, n=40, k=30):
    """Transitions of that task with two observations and one action."""
    rng = np.random.default_rng(seed)
    observation, action = rng.normal(size=(n, 2)), rng.uniform(-1, 1, (n, 1))
    draws = rng.uniform(-1, 1, (k, 1)), rng.normal(size=(k, 2)), rng.normal(size=(k, 2))
    after = np.array([follow(*pair) for pair in zip(observation, action, strict=True)])
    return Coverage(*(x.astype(np.float32) for x in (observation, action, after, *draws)))


def numbers(seed):
    """Those of a random reward."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=5).astype(np.float32), rng.normal(size=2).astype(np.float32)


def random_reward(into, out):
    """A smooth function of all three arguments."""

    def reward(observation, action, following):
        joined = jnp.concatenate([observation, action, following], axis=-1)
        return out[0] * jnp.tanh(joined @ into) + out[1] * jnp.sin(joined @ into[::-1])

    return reward


def shaped(reward, scale=3.0, constant=-2.0):
    """The same preferences among policies: scaled, moved, and shaped by a potential."""

    def potential(observation):
        return jnp.sin(observation[..., 0]) * 5.0 + observation[..., 1] ** 2

    def other(observation, action, following):
        shaping = DISCOUNT * potential(following) - potential(observation)
        return scale * reward(observation, action, following) + constant + shaping

    return other


def slow_epic(reward, made):
    """By the definition, one term at a time, in float64."""
    made = Coverage(*(np.asarray(leaf, np.float64) for leaf in made))
    draws = list(zip(made.actions, made.next_observations, strict=True))

    def mean_from(state):
        return np.mean([reward(state, action, after) for action, after in draws])

    overall = np.mean([mean_from(state) for state in made.observations])
    return [
        float(reward(s, a, after)) + DISCOUNT * mean_from(after) - mean_from(s) - DISCOUNT * overall
        for s, a, after in zip(*made[:3], strict=True)
    ]


def slow_dard(reward, made):
    made = Coverage(*(np.asarray(leaf, np.float64) for leaf in made))
    found = []
    for s, a, after in zip(*made[:3], strict=True):
        terms = []
        for action in made.actions:
            here, there = follow(s, action), follow(after, action)
            terms.append(
                DISCOUNT * reward(after, action, there)
                - reward(s, action, here)
                - DISCOUNT * reward(here, action, there)
            )
        found.append(float(reward(s, a, after)) + np.mean(terms))
    return found


def forms(reward, made):
    """The canonical forms by their names."""
    return {
        "epic": distances.epic(reward, made, DISCOUNT),
        "dard": distances.dard(reward, follow, made, DISCOUNT),
    }


COVERED = covered(0)


@jax.jit
def to_shaped(into, out, scale, constant):
    """The distances of a random reward to itself, scaled, moved and shaped."""
    made, reward = COVERED, random_reward(into, out)
    ours, theirs = forms(reward, made), forms(shaped(reward, scale, constant), made)
    return jax.tree.map(distances.pearson, ours, theirs)


def test_canonical_forms_are_those_of_the_definitions():
    made, reward = covered(0, n=7, k=5), random_reward(*numbers(3))
    with jax.enable_x64():
        slow = {"epic": slow_epic(reward, made), "dard": slow_dard(reward, made)}
    for name, form in jax.jit(lambda: forms(reward, made))().items():
        np.testing.assert_allclose(form, slow[name], atol=2e-5)


@given(seed=st.integers(0, 1_000), scale=st.floats(0.1, 10.0), constant=st.floats(-5.0, 5.0))
def test_shaping_scale_and_constants_are_no_distance(seed, scale, constant):
    same, opposite = (to_shaped(*numbers(seed), scale, constant) for scale in (scale, -scale))
    for name in ("epic", "dard"):
        assert same[name] < 5e-3
        assert opposite[name] > 1 - 1e-3


def test_unrelated_rewards_are_far_from_each_other():
    # Noise that is fixed by the bits of its arguments.
    rng = np.random.default_rng(0)
    ours, theirs = rng.normal(size=(2, 20_000))
    assert distances.pearson(ours, theirs) == pytest.approx(UNRELATED, abs=0.01)
    nothing = np.zeros(20_000)
    assert distances.pearson(ours, nothing) == pytest.approx(UNRELATED)
    assert distances.pearson(ours, ours) == 0.0


starc = jax.jit(lambda dynamics, reward: distances.starc(dynamics, reward, DISCOUNT))
normalised = jax.jit(distances.normalised)


def starc_problem(seed):
    """Random dynamics without an end, and a reward of states and actions."""
    rng = np.random.default_rng(seed)
    dynamics = rng.dirichlet(np.ones(6), size=(6, 3))
    return dynamics.astype(np.float32), rng.normal(size=(6, 3)).astype(np.float32)


@given(seed=st.integers(0, 1_000), scale=st.floats(0.1, 10.0), constant=st.floats(-5.0, 5.0))
def test_starc_is_blind_to_what_changes_no_policys_rank(seed, scale, constant):
    dynamics, reward = starc_problem(seed)
    potential = np.random.default_rng(seed + 1).normal(size=6)
    other = scale * reward + constant + DISCOUNT * dynamics @ potential - potential[:, None]
    rewards = np.float32([reward, other, -other])
    ours, theirs, opposite = np.asarray(starc(dynamics, rewards))
    assert normalised(ours, theirs) < 5e-3
    assert normalised(ours, opposite) > 1 - 1e-3


def test_starc_is_that_of_a_sum_over_the_policys_future():
    dynamics, reward = starc_problem(0)
    go_on, paid = dynamics.astype(np.float64).mean(axis=1), reward.astype(np.float64).mean(axis=1)
    values = sum(DISCOUNT**t * np.linalg.matrix_power(go_on, t) @ paid for t in range(400))
    slow = reward - values[:, None] + DISCOUNT * dynamics @ values
    np.testing.assert_allclose(starc(dynamics, reward), slow, atol=1e-5)
    # Several rewards at once, and sparse dynamics.
    both = starc(mdps.sparse(dynamics), np.stack([reward, 2 * reward]))
    np.testing.assert_allclose(both, [slow, 2 * slow], atol=1e-5)


def test_uniform_coverage_lies_within_the_bounds_and_follows_the_task():
    env = pools.ENV
    step = coverage_lib.successor(env)

    @jax.jit
    def cover(key):
        made = coverage_lib.uniform(key, env, 50, 20)
        return made, jax.vmap(step)(made.observation, made.action)

    made, following = jax.device_get(cover(jax.random.key(0)))
    spec = env.spec
    for leaf in (made.observation, made.observations, made.next_observations):
        assert np.all((leaf >= spec.observation_low) & (leaf <= spec.observation_high))
    assert np.abs(made.actions).max() > 0.8
    np.testing.assert_array_equal(following, made.next_observation)
    # Bounds as large as floats are say nothing, although they are finite.
    largest = np.full(2, np.finfo(np.float32).max)
    boundless = spec._replace(observation_low=-largest, observation_high=largest)
    with pytest.raises(ValueError, match="no finite bounds"):
        coverage_lib.uniform(jax.random.key(0), env._replace(spec=boundless), 5, 2)
    with pytest.raises(ValueError, match="does not say which state"):
        coverage_lib.successor(env._replace(state_at=None))


def test_visited_coverage_is_of_the_steps_that_were_made():
    transition = pools.scripted(3).transition
    draw = jax.jit(lambda key: coverage_lib.visited(key, transition, 30, 10))
    made = draw(jax.random.key(0))
    rows = {tuple(row) for row in np.hstack([transition.observation, transition.action])}
    assert all(tuple(row) in rows for row in np.hstack([made.observation, made.action]))
    assert [leaf.shape for leaf in made[3:]] == [(10, 1), (10, 2), (10, 2)]
