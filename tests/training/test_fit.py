import functools

import jax
import pytest

from cmedirl_jax import training
from tests.support import pools
from tests.support.trainers import ENV, SMALL


def test_fit_trains_and_evaluates_all_seeds():
    fit = functools.partial(
        training.fit, seeds=3, steps=60, settings=SMALL, evaluate_every=20, evaluation_starts=2
    )
    pool = pools.scripted()
    result = jax.jit(lambda key: fit(key, ENV, "hs-ddpg", pool))(jax.random.key(0))
    assert result.evaluations.return_mean.shape == (3, 4)
    assert result.episodes.done.shape == (3, 60)
    assert result.states.episode.tolist() == [1, 1, 1]
    with pytest.raises(ValueError, match="unknown method 'sarsa'; there are: ddpg"):
        fit(jax.random.key(0), ENV, "sarsa")
    elsewhere = pool._replace(metadata={"env": "Pendulum-v1"})
    with pytest.raises(ValueError, match="made for environment 'Pendulum-v1'"):
        fit(jax.random.key(0), ENV, "hs-ddpg", elsewhere)
    with pytest.raises(ValueError, match="needs demonstrations"):
        fit(jax.random.key(0), ENV, "me-ddpg")
    with pytest.raises(ValueError, match="seeds must be at least 1, got 0"):
        training.fit(jax.random.key(0), ENV, "ddpg", seeds=0, steps=300)
    with pytest.raises(ValueError, match="multiple of evaluate_every"):
        training.fit(jax.random.key(0), ENV, "ddpg", seeds=1, steps=300)
