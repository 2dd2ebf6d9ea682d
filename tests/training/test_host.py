"""Many seeds on a task of the host, in one call."""

import functools

import jax
import numpy as np
import pytest
import scipy.stats

from cmedirl_jax import envs, networks, training
from cmedirl_jax.training import evaluation, host
from tests.support import host_tasks, pools
from tests.support.trainers import SMALL

DOCK = envs.from_gymnasium("Dock-v0")


def test_fit_trains_and_evaluates_all_seeds():
    result = host.fit(
        jax.random.key(0),
        DOCK,
        "ddpg",
        seeds=3,
        steps=120,
        settings=SMALL,
        evaluate_every=40,
        evaluation_starts=2,
    )
    assert result.evaluations.return_mean.shape == (3, 4)
    assert result.episodes.done.shape == (3, 120)
    assert result.states.episode.tolist() == [2, 2, 2]
    assert (result.evaluations.length_mean == 60.0).all()
    # Observations without bounds are normalised by those seen: 121 steps, and two more starts.
    assert result.states.observation_statistics.count.tolist() == [123.0] * 3
    rows = np.asarray(result.states.storage)[:, :120]
    assert np.isfinite(rows).all()


def test_episodes_are_played_from_the_given_starts():
    vector = DOCK.vector(2)
    pushes = np.array([[0.1], [1.0]])
    found = evaluation.rollout_on_host(lambda seen: pushes, vector, np.array([3, 4, 3]), 60)
    for index, seed in np.ndindex(2, 3):
        task = host_tasks.Dock()
        task.reset(seed=[3, 4, 3][seed])
        total, steps, over = 0.0, 0, False
        while not over and steps < 60:
            _, reward, over, _, _ = task.step(np.float32(pushes[index]))
            total, steps = total + reward, steps + 1
        assert found.episode_return[index, seed] == pytest.approx(total, rel=1e-5)
        assert found.length[index, seed] == steps
        assert found.terminated[index, seed] == over
    assert found.terminated.tolist() == [[False] * 3, [True] * 3]
    summary = jax.vmap(evaluation.summarise)(found)
    np.testing.assert_allclose(summary.goal_fraction, [0.0, 1.0])


def test_the_other_fit_names_this_one():
    with pytest.raises(
        ValueError, match=r"Dock-v0 is stepped on the host: use training\.host\.fit"
    ):
        training.fit(jax.random.key(0), DOCK, "ddpg", seeds=1, steps=250)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "sarsa"}, "unknown method 'sarsa'; there are: ddpg"),
        ({"method": "me-ddpg"}, "me-ddpg needs demonstrations"),
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"steps": 300}, "multiple of evaluate_every"),
        ({"method": "tabular-me-ddpg"}, "puts the task on a grid"),
        ({"demonstrations": pools.scripted(), "method": "me-ddpg"}, "made for environment"),
    ],
    ids=str,
)
def test_what_cannot_be_trained_is_refused(changes, message):
    given = {"method": "ddpg", "seeds": 1, "steps": 500, "settings": SMALL} | changes
    with pytest.raises(ValueError, match=message):
        host.fit(jax.random.key(0), DOCK, **given)


def test_the_pendulum_learns_alike_in_jax_and_through_the_host():
    """Both ways' policies are judged in JAX, on the same starts."""
    env = envs.make("Pendulum-v1")
    few = {"steps": 300, "evaluate_every": 300, "evaluation_starts": 1, "settings": SMALL}
    many = {"seeds": 32, **few}
    in_jax = jax.jit(lambda key: training.fit(key, env, "ddpg", **many))(jax.random.key(0))
    outside = envs.from_gymnasium("gymnasium:Pendulum-v1")
    through_host = host.fit(jax.random.key(1), outside, "ddpg", **many)
    made = networks.make(env.spec, SMALL.architecture)

    @jax.jit
    @jax.vmap
    def judge(actor):
        policy = functools.partial(networks.policy, made, actor)
        return evaluation.evaluate(policy, env, env.default_params, 10).return_mean

    ours, theirs = (judge(each.states.agent.actor) for each in (in_jax, through_host))
    assert scipy.stats.ks_2samp(ours, theirs).pvalue > 0.01
    # A difference of one standard deviation would have been seen.
    assert scipy.stats.ks_2samp(ours, ours + ours.std()).pvalue < 0.01
