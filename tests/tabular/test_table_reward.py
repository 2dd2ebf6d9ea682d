import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.irl import IRLHParams, shaping
from cmedirl_jax.tabular import discretise, interpolation, table_reward
from cmedirl_jax.tabular.interpolation import Grid
from tests.support import pools

STATES, ACTIONS = discretise.grids(pools.ENV.spec, (6, 5), (3,))
TABLE = np.random.default_rng(0).normal(size=(30, 3)).astype(np.float32)
VISITS = np.arange(30, dtype=np.float32) % 4
LEARNER = table_reward.make(STATES, ACTIONS)
reward_of = jax.jit(LEARNER.reward)


def table_state(table=TABLE, bound=10.0, deviation=0.05):
    return table_reward.state(jnp.asarray(table), VISITS, deviation, IRLHParams(bound=bound))


def test_where_demonstrations_go_it_has_mean_0_and_the_deviation_asked_for():
    weight = np.float64(VISITS / VISITS.sum())
    mean = (weight @ np.float64(TABLE)).mean()
    deviation = np.sqrt((weight @ (TABLE - mean) ** 2).mean())
    expected = 0.05 * (TABLE - mean) / deviation
    np.testing.assert_allclose(table_state().params, expected, atol=1e-6)
    np.testing.assert_allclose(
        table_state(bound=0.03).params, expected.clip(-0.03, 0.03), atol=1e-6
    )


def test_the_reward_is_the_table_at_the_grids_points():
    state = table_state()
    observation = np.repeat(interpolation.points(STATES)[:, None], 3, axis=1)
    action = np.broadcast_to(interpolation.points(ACTIONS), (30, 3, 1))
    reward = reward_of(state, observation, action)
    np.testing.assert_allclose(reward, state.params, atol=1e-5)


def test_between_the_points_it_is_linear_in_the_action():
    state = table_state()
    observation = np.tile(np.float32([-0.31, 0.013]), (3, 1))
    action = np.float32([[-1.0], [-0.75], [0.0]])
    low, middle, high = np.asarray(reward_of(state, observation, action))
    np.testing.assert_allclose(middle, 0.75 * low + 0.25 * high, rtol=1e-5)


def test_it_learns_nothing():
    state = table_state()
    batch = jax.tree.map(lambda leaf: leaf[:4], pools.scripted().transition)
    after, _ = jax.jit(LEARNER.update)(state, batch, batch)
    np.testing.assert_array_equal(after.params, state.params)
    nothing = reward_of(LEARNER.init(jax.random.key(0)), *batch[:2])
    assert nothing.tolist() == [0.0] * 4
    np.testing.assert_array_equal(shaping.additive(batch.reward, nothing), batch.reward)


def test_a_table_with_a_nan_is_refused():
    with pytest.raises(ValueError, match=r"table must be finite, got nan at \[0, 0\]"):
        table_state(jnp.full((30, 3), jnp.nan))


def test_a_table_is_refused_before_it_is_made():
    states = Grid((0.0,) * 4, (1.0,) * 4, (41,) * 4)
    with pytest.raises(ValueError, match=r"a table of rewards would be 9\.69e\+8 numbers"):
        table_reward.make(states, Grid((0.0,) * 3, (1.0,) * 3, (7,) * 3))


def test_a_table_of_zeros_stays_zero():
    assert (table_state(jnp.zeros((30, 3))).params == 0).all()


@pytest.mark.parametrize(
    ("visits", "deviation", "message"),
    [
        (jnp.ones(29), 1.0, r"visits: expected shape \(30,\), got \(29,\)"),
        (-jnp.ones(30), 1.0, r"visits must be at least 0 and finite, got -1.0 at \[0\]"),
        (jnp.ones(30), 0.0, "deviation must be positive"),
    ],
)
def test_impossible_scales_are_refused(visits, deviation, message):
    with pytest.raises(ValueError, match=message):
        table_reward.state(jnp.asarray(TABLE), visits, deviation, IRLHParams())
