import chex
import jax
import numpy as np
import pytest

from cmedirl_jax import envs, training
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cells.slots import Slots
from cmedirl_jax.training import seeds
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.types import DemonstrationSubset
from tests.support import pools
from tests.support.trainers import ENV, SMALL, data

SEEDS, KEY = 3, jax.random.key(3)
POOL = pools.for_learners(pools.scripted())


@pytest.fixture(scope="module")
def compiled():
    return compiled_lib.compiler(ENV, jax.devices()[:1], capacity=50, subset_size=3, group=2)


def begin(compiled, method, n_demos=2, first_seed=0, pool=None):
    programs = compiled(METHODS[method], SMALL, SEEDS)
    slots = Slots(programs.slots, SEEDS, programs.group, programs.devices)
    pool = POOL if pool is None else pool
    state = compiled_lib.begin(programs, slots, KEY, pool, n_demos, first_seed)
    return jax.tree.map(lambda leaf: np.asarray(leaf)[slots.of_seed], state.agent.actor)


def test_methods_share_one_hot_start(compiled, monkeypatch):
    shared = compiled(METHODS["hs-ddpg"], SMALL, SEEDS).hot_start
    assert compiled(METHODS["ddpg"], SMALL, SEEDS).hot_start is None
    calls, fit = [], shared._fit
    monkeypatch.setattr(shared, "_fit", lambda *args: calls.append(args) or fit(*args))
    actors = [begin(compiled, method) for method in ("hs-ddpg", "hs-me-ddpg", "bc")]
    assert len(calls) == 1
    for actor in actors[1:]:
        jax.tree.map(np.testing.assert_array_equal, actor, actors[0])
    # Whatever else it is asked, it answers anew.
    begin(compiled, "bc", n_demos=3)
    begin(compiled, "bc", n_demos=3, first_seed=1)
    begin(compiled, "bc", n_demos=3, first_seed=1, pool=jax.tree.map(lambda leaf: leaf, POOL))
    assert len(calls) == 4


@pytest.mark.parametrize("method", ["ddpg", "hs-me-ddpg"])
def test_seeds_begin_as_the_trainer_lets_them(compiled, method):
    actor = begin(compiled, method, first_seed=1)
    trainer = training.make(ENV, METHODS[method], SMALL, capacity=50, subset_size=3)
    pool = data()
    alone = jax.jit(lambda key: trainer.init(key, pool, 2).agent.actor)
    for seed, key in enumerate(seeds.keys(KEY, SEEDS + 1)[1:]):
        one = jax.tree.map(lambda leaf, seed=seed: leaf[seed], actor)
        jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, atol=1e-4), one, alone(key))


def test_a_later_chunk_of_a_task_on_the_host_compiles_nothing():
    task = envs.find("tests.support.host_tasks:Dock-v0")
    compile_once = compiled_lib.compiler(task, jax.devices()[:1], capacity=50, subset_size=None)
    programs = compile_once(METHODS["ddpg"], SMALL, SEEDS)
    slots = Slots(programs.slots, SEEDS, programs.group, programs.devices)
    state = compiled_lib.begin(programs, slots, KEY, None, 0)
    for first in (0, 5, 10):
        steps = np.arange(first, first + 5, dtype=np.int32)
        state, _ = programs.run(state, 1, None, steps, None)
    halves = programs.run.__self__._halves
    assert halves.learn._cache_size() == halves.behave._cache_size() == 1


@pytest.mark.parametrize("method", ["ddpg", "hs-me-ddpg"])
def test_shapes_are_those_of_the_beginning(compiled, method):
    programs = compiled(METHODS[method], SMALL, SEEDS)
    slots = Slots(programs.slots, SEEDS, programs.group, programs.devices)
    state = compiled_lib.begin(programs, slots, KEY, POOL, 2)
    shapes = compiled_lib.abstract(programs, POOL, 2)
    chex.assert_trees_all_equal_shapes_and_dtypes(shapes, state)


@pytest.mark.optimised
def test_shapes_are_known_where_programs_have_compiler_options():
    compiler = compiled_lib.compiler(ENV, jax.devices()[:1], capacity=50, subset_size=3, group=2)
    programs = compiler(METHODS["hs-me-ddpg"], SMALL, SEEDS)
    state = compiled_lib.abstract(programs, POOL, 2)
    assert state.storage.shape[0] == programs.slots


def test_each_learner_draws_from_the_episodes_of_its_row(compiled):
    programs = compiled(METHODS["hs-ddpg"], SMALL, SEEDS)
    slots = Slots(programs.slots, SEEDS, programs.group, programs.devices)
    start, length = POOL.episodes
    rows = np.arange(12).reshape(4, 3)
    own = POOL._replace(episodes=DemonstrationSubset(*(leaf[0][rows] for leaf in (start, length))))
    state = compiled_lib.begin(programs, slots, KEY, own, 3, first_seed=1)
    drawn = np.asarray(state.subset.start)[slots.of_seed]
    np.testing.assert_array_equal(np.sort(drawn), start[0][rows[1:]])
