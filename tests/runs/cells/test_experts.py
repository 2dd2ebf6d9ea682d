import types

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs.cells import experts
from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.record import EvaluationRows
from cmedirl_jax.runs.config import ExpertSettings
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.training.evaluation import Evaluation

EPISODES = 4
STRENGTHS = np.array([0.3, 0.0], np.float32)
"""Of two scripted policies: one reaches the goal, the other never moves."""


def act(strength, observation):
    """Push in the direction of motion."""
    return strength * jnp.where(observation[..., 1:] >= 0, 1.0, -1.0)


@pytest.fixture(scope="module")
def recorded(env):
    keys = jax.random.split(jax.random.key(3), STRENGTHS.size)
    record = jax.vmap(lambda strength, key: experts.record(act, env, strength, key, EPISODES))
    return jax.tree.map(np.asarray, jax.jit(record)(STRENGTHS, keys))


@pytest.fixture(scope="module")
def pool(recorded, spec):
    return experts.flatten(*recorded, {"env": spec.id})


def gymnasium_episode(start, strength):
    """Return and length of the scripted policy's episode in Gymnasium."""
    environment = gymnasium.make("MountainCarContinuous-v0")
    environment.reset(seed=0)
    environment.unwrapped.state = observation = start
    total, length, done = 0.0, 0, False
    while not done:
        action = strength * np.where(observation[1:] >= 0, 1.0, -1.0)
        observation, reward, terminated, truncated, _ = environment.step(action)
        total, length, done = total + reward, length + 1, terminated or truncated
    environment.close()
    return total, length


@pytest.mark.parametrize(("which", "chosen"), [("best", [3]), ("median", [1]), ("all", [1, 3, 4])])
def test_choose_ranks_only_the_experts_that_solved_the_task(which, chosen):
    returns = np.array([89.0, 91.0, 10.0, 94.0, 90.0])
    np.testing.assert_array_equal(experts.choose(returns, which, 90.0), chosen)


def test_the_median_of_two_experts_is_the_lower():
    np.testing.assert_array_equal(experts.choose(np.array([94.0, 91.0]), "median", 90.0), [1])


@pytest.mark.parametrize("which", ["best", "median", "all"])
def test_choose_takes_nobody_if_none_solved_the_task(which):
    assert experts.choose(np.array([89.0, 10.0]), which, 90.0).size == 0


def test_recorded_episodes_are_a_valid_pool(pool, spec):
    demonstrations.validate(pool, spec)
    assert {leaf.dtype for leaf in pool.transition} == {np.dtype("f4"), np.dtype("?")}


def test_recorded_episodes_are_gymnasiums(pool):
    start, length = demonstrations.episodes(pool)
    starts = np.float64(pool.transition.observation[start])
    strengths = np.repeat(STRENGTHS, EPISODES)
    found = [gymnasium_episode(*episode) for episode in zip(starts, strengths, strict=True)]
    returns, lengths = zip(*found, strict=True)
    np.testing.assert_array_equal(length, lengths)
    np.testing.assert_allclose(demonstrations.returns(pool), returns, atol=1e-4)
    assert pool.metadata["return_mean"] == pytest.approx(np.mean(returns))
    assert pool.metadata["return_std"] == pytest.approx(np.std(returns))


def test_episodes_start_at_different_places_and_last_differently(pool):
    start, length = demonstrations.episodes(pool)
    positions, velocities = pool.transition.observation[start].T
    assert np.unique(positions).size == STRENGTHS.size * EPISODES
    assert (np.abs(positions + 0.5) <= 0.1).all()
    assert (velocities == 0.0).all()
    assert np.unique(length[:EPISODES]).size > 1


def test_each_step_begins_where_the_one_before_ended(pool):
    same_episode = np.diff(pool.episode) == 0
    np.testing.assert_array_equal(
        pool.transition.observation[1:][same_episode],
        pool.transition.next_observation[:-1][same_episode],
    )


def test_episodes_end_at_the_goal_or_by_the_time_limit(pool, spec):
    start, length = demonstrations.episodes(pool)
    last = start + length - 1
    solved = np.repeat(STRENGTHS > 0, EPISODES)
    np.testing.assert_array_equal(pool.transition.terminated[last], solved)
    np.testing.assert_array_equal(pool.truncated[last], ~solved)
    assert (length[~solved] == spec.max_episode_steps).all()


def test_reaching_the_goal_at_the_last_step_is_no_truncation(env):
    start = -0.5
    _, limit = gymnasium_episode(np.array([start, 0.0]), STRENGTHS[0])
    params = env.default_params.replace(start_low=start, start_high=start, max_episode_steps=limit)
    spec = env.spec._replace(max_episode_steps=limit)
    short = env._replace(spec=spec, default_params=params)
    recorded = jax.jit(lambda key: experts.record(act, short, STRENGTHS[0], key, 1))
    transition, running, truncated = recorded(jax.random.key(0))
    assert running.all()
    assert transition.terminated[0, -1]
    assert not truncated.any()


def test_an_episode_that_the_task_does_not_end_is_truncated_at_the_specifications_limit(env):
    params = env.default_params.replace(max_episode_steps=10**6)
    endless = env._replace(
        spec=env.spec._replace(max_episode_steps=4), default_params=params, state_at=None
    )
    recorded = jax.jit(lambda key: experts.record(act, endless, STRENGTHS[1], key, 2))
    pool = experts.flatten(
        *jax.tree.map(np.asarray, recorded(jax.random.key(0))), {"env": env.spec.id}
    )
    demonstrations.validate(pool, endless.spec)
    np.testing.assert_array_equal(pool.truncated, [False, False, False, True] * 2)


@pytest.fixture
def make_pool(env, monkeypatch):
    """`make_pool` with the scripted policies in the place of trained experts.

    Takes the seeds that were evaluated at the end, and their returns.
    """

    def make(seeds, returns, trajectories=3):
        def train(*args, seeds_count, **kwargs):
            zeros = np.zeros(len(seeds))
            found = Evaluation(np.array(returns), zeros, zeros, zeros)
            first = EvaluationRows("steps", np.arange(2), *[None] * 4)
            last = EvaluationRows("steps", np.array(seeds), zeros, zeros, found, None)
            return CellResult(
                evaluations=[first, last],
                episodes=None,
                best=None,
                reward=None,
                env_steps=np.full(seeds_count, 500),
                demonstration_steps=None,
                diverged=~np.isin(np.arange(seeds_count), seeds),
                final=STRENGTHS,
            )

        monkeypatch.setattr(experts.cell_lib, "train", train)
        return experts.make_pool(
            jax.random.key(0),
            env,
            ExpertSettings(seeds=STRENGTHS.size, steps=500, trajectories=trajectories),
            "all",
            types.SimpleNamespace(evaluator=types.SimpleNamespace(act=act)),
            lambda progress: None,
        )

    return make


def test_the_pool_is_made_by_the_experts_that_solved_the_task(make_pool, spec, tmp_path):
    pool = make_pool([0, 1], [97.0, 0.0])
    demonstrations.save(tmp_path / "pool.npz", pool)
    metadata = demonstrations.load(tmp_path / "pool.npz", spec).metadata
    assert metadata["experts_demonstrating"] == [0]
    assert metadata["experts_solved"] == 1
    assert metadata["experts_trained"] == 2
    assert metadata["expert_env_steps"] == 1_000
    assert (demonstrations.returns(pool) > 90.0).all()
    assert demonstrations.returns(pool).size == 3


def test_several_experts_share_the_trajectories_and_make_no_fewer_than_asked(make_pool):
    pool = make_pool([0, 1], [97.0, 95.0], trajectories=3)
    np.testing.assert_array_equal(demonstrations.returns(pool) > 90.0, [True, True, False, False])


def test_no_expert_that_solved_the_task_is_a_users_error(make_pool):
    with pytest.raises(UserError, match=r"^--experts: none of 2 experts .*--experts\.steps"):
        make_pool([0, 1], [89.0, 0.0])


def test_a_diverged_expert_does_not_shift_the_others(make_pool):
    pool = make_pool([1], [97.0])
    assert pool.metadata["experts_demonstrating"] == [1]
