"""The loop around a task on the host does what `Trainer.run` does around a task in JAX."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs, training
from cmedirl_jax.envs import stepping
from cmedirl_jax.training import host_loop, seeds
from cmedirl_jax.training.methods import METHODS
from tests.support import host_tasks, trainers
from tests.support.trainers import LIMIT, SMALL, data

SEEDS = 3
STEPS = LIMIT + 15
# Episodes that all begin at one place, so that both ways begin them alike.
PARAMS = trainers.ENV.default_params.replace(start_low=-0.5, start_high=-0.5)
IN_JAX = trainers.ENV._replace(default_params=PARAMS)
ON_HOST = envs.from_gymnasium(lambda: envs.to_gymnasium(IN_JAX))
TRAJECTORIES = trainers.with_(
    reward={"objective": "trajectory"},
    reward_batches={"trajectories": 2},
    reward_schedule={"period": 20},
)


def begin(method, settings=SMALL):
    """The halves, the sub-environments and the states before their first step."""
    uses = METHODS[method].uses_demonstrations
    task = ON_HOST._replace(spec=IN_JAX.spec)
    trainer = training.make(task, METHODS[method], settings, capacity=400)
    halves = host_loop.compile_halves(trainer, LIMIT)
    vector = task.vector(SEEDS)
    keys, pool = seeds.keys(jax.random.key(0), SEEDS), data() if uses else None
    states = host_loop.begin(halves, trainer, vector, keys, pool, 3)
    return trainer, halves, vector, states


@pytest.fixture(scope="module")
def plain():
    """DDPG's halves, whose states are to be copied before they are stepped."""
    return begin("ddpg")


@pytest.mark.parametrize("method", [pytest.param("ddpg", marks=pytest.mark.slow), "hs-me-ddpg"])
def test_it_learns_what_run_learns_in_jax(method):
    pool = data() if METHODS[method].uses_demonstrations else None
    in_jax = training.make(IN_JAX, METHODS[method], SMALL, capacity=400)
    keys, steps = seeds.keys(jax.random.key(0), SEEDS), np.arange(STEPS, dtype=np.int32)
    before = jax.jit(jax.vmap(lambda key: in_jax.init(key, pool, 3)))(keys)
    run = jax.jit(jax.vmap(in_jax.run, in_axes=(0, None, None)))
    expected, expected_log = run(before, pool, steps)
    _, halves, vector, states = begin(method)
    # In two calls, as checkpoints and evaluations cut them.
    states, first = host_loop.run(halves, vector, states, pool, steps[:30])
    states, second = host_loop.run(halves, vector, states, pool, steps[30:])
    log = jax.tree.map(lambda *parts: np.concatenate(parts, axis=1), first, second)
    close = {"rtol": 1e-3, "atol": 1e-4}
    chex.assert_trees_all_close(log, jax.tree.map(np.asarray, expected_log), **close)
    chex.assert_trees_all_close(states.agent.actor, expected.agent.actor, **close)
    chex.assert_trees_all_close(states.reward, expected.reward, **close)
    chex.assert_trees_all_close(states.storage, expected.storage, **close)
    assert states.episode.tolist() == [1] * SEEDS


def test_a_second_call_compiles_nothing(plain):
    _, halves, vector, states = plain
    states, steps = jax.tree.map(jnp.copy, states), np.arange(LIMIT, dtype=np.int32)
    states, _ = host_loop.run(halves, vector, states, None, steps)
    host_loop.run(halves, vector, states, None, steps + LIMIT)
    for function in (halves.behave, halves.learn, halves.seeds):
        assert function._cache_size() == 1


def test_a_seeds_starts_depend_on_its_key_and_step_alone(plain):
    _, halves, _, states = plain
    one = jax.jit(lambda states: jax.tree.map(lambda leaf: leaf[1:2], states))(states)
    for step in (0, 7):
        numbers = np.asarray(halves.seeds(states, np.int32(step)))
        assert len(set(numbers.tolist())) == SEEDS
        assert halves.seeds(one, np.int32(step))[0] == numbers[1]
    assert halves.seeds(states, np.int32(1))[0] != halves.seeds(states, np.int32(2))[0]


def test_an_episode_that_is_cut_off_is_no_trajectory():
    _, halves, vector, states = begin("me-ddpg", TRAJECTORIES)
    pool, cut = data(), 25
    states, _ = host_loop.run(halves, vector, states, pool, np.arange(cut, dtype=np.int32))
    start = stepping.reset(vector, np.asarray(halves.seeds(states, np.int32(cut - 1))))
    states = halves.begin_episode((states, start), np.int32(cut))
    assert states.episode_length.tolist() == [0] * SEEDS
    np.testing.assert_array_equal(states.observation, start)
    assert (states.sampler.source.current == cut).all()
    later = np.arange(cut, cut + LIMIT, dtype=np.int32)
    states, log = host_loop.run(halves, vector, states, pool, later)
    # One whole episode since then, and none before.
    assert log.done.sum(axis=1).tolist() == [1] * SEEDS
    assert states.sampler.source.count.tolist() == [1] * SEEDS
    assert states.sampler.source.start[:, 0].tolist() == [cut] * SEEDS
    assert states.sampler.source.length[:, 0].tolist() == [LIMIT] * SEEDS


def test_an_interruption_between_two_episodes_changes_nothing():
    limit = 30
    task = envs.from_gymnasium(host_tasks.Dock, max_episode_steps=limit)
    trainer = training.make(task, METHODS["ddpg"], SMALL, capacity=400)
    halves = host_loop.compile_halves(trainer, limit)
    vector = task.vector(SEEDS)
    states = host_loop.begin(halves, trainer, vector, seeds.keys(jax.random.key(0), SEEDS))
    steps = np.arange(limit, dtype=np.int32)
    states, _ = host_loop.run(halves, vector, states, None, steps)
    assert states.episode_length.tolist() == [0] * SEEDS
    another = task.vector(SEEDS)
    start = stepping.reset(another, np.asarray(halves.seeds(states, np.int32(limit - 1))))
    interrupted = halves.begin_episode((states, start), np.int32(limit))
    ends = [
        host_loop.run(halves, vector, states, None, limit + steps)[0]
        for vector, states in ((vector, states), (another, interrupted))
    ]
    chex.assert_trees_all_equal(*ends)


def test_a_task_on_the_host_is_not_run_nor_begun_in_jax():
    trainer = training.make(ON_HOST, METHODS["ddpg"], SMALL, capacity=10)
    with pytest.raises(ValueError, match=r"is stepped on the host: see training\.host"):
        trainer.run(None, None, jnp.arange(3))
    with pytest.raises(ValueError, match="is stepped on the host: give init a start"):
        jax.eval_shape(lambda key: trainer.init(key, None, 0), jax.random.key(0))
    with pytest.raises(ValueError, match="tabular-me-ddpg puts the task on a grid"):
        training.make(ON_HOST, METHODS["tabular-me-ddpg"], SMALL, capacity=10)
