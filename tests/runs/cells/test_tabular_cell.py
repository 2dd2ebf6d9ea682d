import functools
import signal

import jax
import numpy as np
import pytest

from cmedirl_jax import tabular
from cmedirl_jax.agents import hot_start
from cmedirl_jax.runs.cells import tabular_cell
from cmedirl_jax.runs.console.signals import Interruption
from cmedirl_jax.runs.errors import Interrupted
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.tabular import discretise, imitation
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.training import evaluation
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings
from tests.support import pools

SETTINGS = Settings(tabular=TabularSettings(states=9, actions=3, steps=2, centres=3))
SEEDS = 3


@pytest.fixture(scope="module")
def programs(env):
    return tabular_cell.compile_method(
        env,
        METHODS["maxent-irl"],
        SETTINGS,
        devices=jax.devices()[:1],
        subset_size=4,
    )


def train(programs, seeds_count, n_demos=2, checkpointer=None, first_seed=0):
    data = pools.for_learners(pools.scripted())
    return tabular_cell.train(
        programs,
        jax.random.key(3),
        data,
        n_demos,
        seeds_count=seeds_count,
        first_seed=first_seed,
        evaluation_starts=2,
        checkpointer=checkpointer,
    )


@pytest.fixture(scope="module")
def result(programs):
    return train(programs, SEEDS)


def test_one_evaluation_of_the_greedy_policy_and_one_of_the_soft(result, programs, env):
    greedy, soft = result.evaluations
    assert (greedy.protocol, soft.protocol) == ("steps", "soft")
    for found in (greedy, soft):
        assert found.seed.tolist() == [0, 1, 2]
        assert found.env_step.tolist() == found.episode.tolist() == [0, 0, 0]
        assert all(np.isnan(mean).all() for mean in found.means)
    params = env.default_params
    act = discretise.greedy(programs.mdp, result.best[1])
    alone = jax.jit(lambda: evaluation.evaluate(act, env, params, 2))()
    np.testing.assert_allclose(greedy.evaluation.return_mean[1], alone.return_mean, rtol=1e-5)
    assert (greedy.evaluation.return_mean != soft.evaluation.return_mean).any()


@pytest.mark.parametrize("fitted", [1, 2])
def test_a_cell_that_was_stopped_goes_on_with_the_seeds_that_are_left(
    result, programs, tmp_path, fitted
):
    interruption, calls = Interruption(), []

    def fit(*arguments):
        if len(calls) + 1 == fitted and not calls[1:]:
            interruption.signal = signal.SIGTERM
        calls.append(arguments)
        return programs.fit(*arguments)

    def checkpointer(interruption):
        return Checkpointer(
            tmp_path / "cell", {}, every=0.0, interruption=interruption, say=lambda line: None
        )

    listening = programs._replace(fit=fit)
    with pytest.raises(Interrupted):
        train(listening, SEEDS, checkpointer=checkpointer(interruption))
    assert len(calls) == fitted
    found = train(programs, SEEDS, checkpointer=checkpointer(Interruption()))
    for actual, expected in zip(jax.tree.leaves(found), jax.tree.leaves(result), strict=True):
        np.testing.assert_array_equal(actual, expected)


def test_no_environment_step_is_taken_beyond_the_demonstrations(result):
    assert result.env_steps.tolist() == [0, 0, 0]
    assert len(result.episodes.seed) == 0
    lengths = np.asarray(hot_start.data(pools.scripted()).episodes.length)
    assert all(total in lengths[:, None] + lengths for total in result.demonstration_steps)
    assert not result.diverged.any()


def test_a_seed_does_what_it_does_among_more(result, programs):
    more = train(programs, SEEDS + 2)
    # Adam's first steps have the size of its rate, also along gradients that are all rounding.
    alike, other = (np.abs(more.reward[i : i + SEEDS] - result.reward).max() for i in (0, 1))
    assert alike < 0.01 < 0.1 < other


def test_a_later_block_has_the_seeds_of_its_numbers(result, programs):
    later = train(programs, 2, first_seed=1)
    np.testing.assert_array_equal(later.reward, result.reward[1:])
    np.testing.assert_array_equal(later.best, result.best[1:])


def test_the_number_of_demonstrations_does_not_recompile(programs):
    def fitted(n_demos):
        return train(programs, SEEDS, n_demos).demonstration_steps

    before = programs.fit._cache_size()
    assert (fitted(4) > fitted(1)).all()
    assert programs.fit._cache_size() == before


def test_a_policy_is_the_soft_optimal_one_of_its_reward(result, programs):
    mdp = programs.mdp
    solve = functools.partial(tabular.soft_value_iteration, discount=0.99, absorbing=mdp.absorbing)
    policy = jax.jit(solve)(mdp.dynamics, result.reward[0])
    np.testing.assert_allclose(policy.log_probabilities, result.best[0], rtol=1e-3, atol=1e-3)
    shapes = jax.eval_shape(lambda: imitation.discretised(pools.ENV, SETTINGS.tabular))
    assert shapes.states == mdp.states
