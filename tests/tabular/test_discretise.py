import jax
import numpy as np
import pytest

from cmedirl_jax import checks, tabular
from cmedirl_jax.tabular import discretise
from cmedirl_jax.tabular.interpolation import points
from cmedirl_jax.training import evaluation
from tests.support.compiling import jit_as_users

SHAPE, ACTIONS = (31, 21), (5,)


@pytest.fixture(scope="module")
def mdp(env):
    return jax.jit(lambda: discretise.make(env, SHAPE, ACTIONS))()


def true_steps(env, mdp):
    """The environment's own step from every point with every action: `[S - 1, A]`."""

    def step(observation, action):
        params = env.default_params
        return env.step(jax.random.key(0), env.state_at(observation, params), action, params)[1]

    over_actions = jax.vmap(step, in_axes=(None, 0))
    return jax.jit(jax.vmap(over_actions, in_axes=(0, None)))(
        points(mdp.states), points(mdp.actions)
    )


def test_state_at_gives_the_state_of_an_observation(env):
    params = env.default_params
    state, observation = env.reset(jax.random.key(0), params)
    advance = jax.jit(env.step)
    for _ in range(5):
        state, step = advance(jax.random.key(0), state, np.float32([0.7]), params)
        observation = step.observation
    again = env.state_at(observation, params)
    assert (again.position, again.velocity, again.time) == (state.position, state.velocity, 0)


def test_transitions_are_those_of_the_environment(env, mdp):
    steps = true_steps(env, mdp)
    index, weight = (np.asarray(leaf)[:-1] for leaf in mdp.dynamics)
    ended = np.asarray(steps.terminated)
    np.testing.assert_allclose(weight.sum(axis=-1), 1.0, rtol=1e-6)
    np.testing.assert_array_equal((index == mdp.states.size).all(axis=-1), ended)
    # Multilinear weights reproduce the observation.
    place = np.einsum(
        "sak,sako->sao", weight[~ended][None], points(mdp.states)[index[~ended]][None]
    )
    np.testing.assert_allclose(place[0], np.asarray(steps.observation)[~ended], atol=1e-5)
    np.testing.assert_allclose(mdp.reward[:-1], steps.reward, rtol=1e-6)
    assert ended.any()


def test_the_last_state_absorbs(mdp):
    assert mdp.absorbing.sum() == 1
    assert mdp.absorbing[-1]
    assert (mdp.dynamics.next_state[-1] == mdp.states.size).all()
    np.testing.assert_allclose(mdp.dynamics.probability[-1].sum(axis=-1), 1.0, rtol=1e-6)
    assert (mdp.reward[-1] == 0).all()


def test_subsamples_average_over_the_cell(env, mdp):
    finer = jax.jit(lambda: discretise.make(env, SHAPE, ACTIONS, subsamples=2))()
    assert finer.dynamics.next_state.shape == (mdp.states.size + 1, 5, 4 * 4)
    np.testing.assert_allclose(finer.dynamics.probability.sum(axis=-1), 1.0, rtol=1e-5)
    state, action = 14 * 21 + 9, 3
    half = mdp.states.spacing / 4
    around = points(mdp.states)[state] + half * np.array([[-1, -1], [-1, 1], [1, -1], [1, 1]])
    params = env.default_params
    push = points(mdp.actions)[action]
    from_place = jax.jit(
        lambda place: env.step(jax.random.key(0), env.state_at(place, params), push, params)
    )
    steps = [from_place(place) for place in np.float32(around)]
    index, weight = (np.asarray(leaf)[state, action] for leaf in finer.dynamics)
    np.testing.assert_allclose(
        weight @ points(mdp.states)[index],
        np.mean([step.observation for _, step in steps], axis=0),
        atol=1e-5,
    )


def test_a_hundred_by_a_hundred_cells_with_eleven_actions_fit(env):
    shapes = jax.eval_shape(lambda: discretise.make(env, (100, 100), (11,), subsamples=2))
    size = sum(leaf.size * leaf.dtype.itemsize for leaf in jax.tree.leaves(shapes))
    assert size < 20e6
    compiled = jax.jit(lambda: discretise.make(env, (100, 100), (11,), subsamples=2)).lower()
    assert compiled.compile().memory_analysis().temp_size_in_bytes < 2**31 - size


@pytest.mark.optimised
def test_the_discretised_optimum_solves_the_continuous_task(env):
    """The discounted return is close to the table's value."""

    @jit_as_users
    def solve():
        mdp = discretise.make(env, (100, 100), (11,))
        best = tabular.value_iteration(
            mdp.dynamics, mdp.reward, discount=0.99, absorbing=mdp.absorbing
        )
        params = env.default_params
        act = discretise.greedy(mdp, best.action_values)
        rollouts = evaluation.rollout(act, env, params, env.starts(50, params))
        return best, rollouts, discretise.look_up(mdp, best.values, env.starts(50, params)[1])

    best, rollouts, promised = solve()
    assert best.residual <= 1e-6
    assert rollouts.episode_return.mean() > 93
    assert rollouts.terminated.all()
    # The goal's discounted reward, without the actions' cost.
    reached = 100 * 0.99 ** (rollouts.length - 1.0)
    assert ((promised > 0.85 * (reached - 6)) & (promised < reached)).all()


@pytest.mark.optimised
def test_stochastic_policies_draw_their_actions(env, mdp):
    uniform = np.zeros(mdp.reward.shape, np.float32)
    always_right = np.where(np.arange(5) == 4, np.float32(0.0), -np.inf) + uniform
    params = env.default_params
    drawing = discretise.sampled(mdp, env)
    checks.env_spec(drawing.spec)
    assert drawing.spec.action_dim == 5

    @jax.jit
    def returns(preference):
        return evaluation.rollout(
            lambda o: discretise.look_up(mdp, preference, o),
            drawing,
            params,
            env.starts(3, params),
        ).episode_return

    # 999 steps at full throttle, up and down the right hill.
    np.testing.assert_allclose(returns(always_right), -99.9, rtol=1e-4)
    # The mean square of the five actions is a half.
    np.testing.assert_allclose(returns(uniform), -49.95, rtol=0.1)


def test_environments_that_cannot_be_discretised_are_refused(env):
    with pytest.raises(ValueError, match="MountainCarContinuous-v0 does not say which state"):
        discretise.make(env._replace(state_at=None), SHAPE, ACTIONS)
    with pytest.raises(ValueError, match="subsamples must be at least 1, got 0"):
        discretise.make(env, SHAPE, ACTIONS, subsamples=0)
    with pytest.raises(ValueError, match="as many bounds as sizes"):
        discretise.make(env, (10,), ACTIONS)
