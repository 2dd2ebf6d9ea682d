"""That the tuned preset learns, on enough seeds to say so."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import training
from tests import pools

SOLVED = pools.ENV.spec.reward_threshold


@pytest.mark.statistical
def test_tuned_ddpg_solves_the_task():
    fit = jax.jit(lambda key: training.fit(key, pools.ENV, "ddpg", seeds=32, steps=12_000))
    result = fit(jax.random.key(0))
    returns = np.asarray(result.evaluations.return_mean)
    assert np.mean((returns >= SOLVED).any(axis=1)) >= 0.85
    # And it is not the evaluation that is wrong: the training episodes reach the goal too.
    last = jnp.where(result.episodes.done, result.episodes.episode_return, jnp.nan)[:, -2000:]
    assert np.nanmean(last) > 80.0


@pytest.mark.statistical
def test_a_hot_start_solves_the_task_before_the_first_step():
    pool = pools.scripted()
    fit = jax.jit(lambda key: training.fit(key, pools.ENV, "hs-me-ddpg", pool, seeds=32, steps=250))
    returns = np.asarray(fit(jax.random.key(0)).evaluations.return_mean)
    assert np.mean(returns[:, 0] >= SOLVED) >= 0.85
