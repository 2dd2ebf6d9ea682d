"""What training gave, and what is loaded of it: the same numbers."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import networks
from cmedirl_jax.agents import hot_start
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs import load_policy, load_reward
from cmedirl_jax.runs.storage import cells, plain, sealing
from cmedirl_jax.runs.storage.cells import CellKey
from cmedirl_jax.tabular import discretise, imitation, interpolation
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings
from tests.support import cells as cells_of
from tests.support import pools, trainers

SEEDS = 3
FIRST = 2
"""The number of a cell's first seed."""
SPEC = pools.ENV.spec
OBSERVATIONS = np.array([[-0.5, 0.0], [-1.1, -0.05], [0.2, 0.06]], np.float32)
ACTIONS = np.array([[0.3], [-1.0], [0.9]], np.float32)


def save(folder, method, settings, policies, rewards, n_demos=5, study=0, first_seed=FIRST):
    n_demos = n_demos if METHODS[method].uses_demonstrations else 0
    key = CellKey(study, "best", method, n_demos, first_seed, SEEDS)
    description = {"task": plain.plain(SPEC), "settings": plain.plain(settings)}
    trees = {"policies": policies, "rewards": rewards}
    cells.save(folder, key, description, cells_of.rows(key), trees)


def stacked(trees):
    return jax.tree.map(lambda *leaves: np.stack(leaves), *trees)


def trained(method, settings):
    """The actors and the reward states of seeds that were trained for some steps."""
    states = []
    for seed in range(SEEDS):
        _, state, advance = trainers.start(method, settings, key=seed)
        states.append(advance(state, 0, 40)[0])
    return [state.agent.actor for state in states], [state.reward for state in states]


@functools.cache
def drawn_actors(architecture):
    init = jax.jit(networks.make(SPEC, architecture).actor.init)
    return [init(jax.random.key(seed)) for seed in range(SEEDS)]


def drawn(method, settings, moved=0.1):
    """The actors and the reward states of seeds before their first step."""
    # Operation by operation, as the loaded reward is called: both run the same programs.
    init = trainers.compiled(method, settings)[0].algorithm.learner.init
    rewards = [init(jax.random.key(seed)) for seed in range(SEEDS)]
    # A table begins with zeros.
    for seed, reward in enumerate(rewards):
        by = np.float32(moved * (seed + 1))
        params = jax.tree.map(lambda leaf, by=by: np.asarray(leaf) + by, reward.params)
        rewards[seed] = reward.replace(params=params)
    return drawn_actors(settings.architecture), rewards


TRAINED = ("a gauge",)
"""What only training moves; the others are drawn."""
VARIANTS = {
    "another bound": ("me-ddpg", {"reward": {"bound": 0.3}}),
    "a gauge": ("me-ddpg", {"reward": {"gauge": "zero-mean", "gauge_rate": 0.5}}),
    "an absorbing state": ("hs-me-ddpg", {"reward": {"absorbing": True, "bounded_by": "clip"}}),
    "no bound": ("me-ddpg", {"reward": {"bounded_by": "none"}}),
    "features": (
        "me-ddpg",
        {"reward_network": {"kind": "fourier", "order": 2}, "reward": {"bound": 0.3}},
    ),
    "a potential": ("me-ddpg", {"reward_schedule": {"shaping": "potential"}}),
    "a discriminator": ("gail", {"gail": {"form": "logit D", "scale": 0.7}}),
    "a table": ("tabular-me-ddpg", {"tabular": {"states": 9, "actions": 3, "steps": 2}}),
    "random": ("random-reward", {"reward": {"bound": 0.2}}),
    "a constant": ("ddpg-minus-constant", {"reward": {"bound": 0.2}}),
    "another architecture": (
        "me-ddpg",
        {"architecture": {"hidden": (4,), "normalise_observation": "none"}},
    ),
    "other normalisation": (
        "me-ddpg",
        {"architecture": {"actor_normalisation": "layer", "critic_normalisation": "none"}},
    ),
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_what_is_loaded_gives_the_numbers_that_training_gave(tmp_path, variant):
    method, changes = VARIANTS[variant]
    settings = trainers.with_(**changes)
    make = trained if variant in TRAINED else drawn
    actors, rewards = make(method, settings)
    save(tmp_path, method, settings, stacked(actors), stacked([r.params for r in rewards]))
    trainer, _, _ = trainers.compiled(method, settings)
    learner = trainer.algorithm.learner
    # Numpy and JAX round differently where both could compute.
    observations, actions = jnp.asarray(OBSERVATIONS), jnp.asarray(ACTIONS)
    for seed, (actor, reward) in enumerate(zip(actors, rewards, strict=True)):
        act = load_policy(tmp_path, method, FIRST + seed)
        np.testing.assert_array_equal(act(OBSERVATIONS), trainer.act(actor, observations))
        np.testing.assert_array_equal(act(OBSERVATIONS[0]), trainer.act(actor, observations[0]))
        r_d = load_reward(str(tmp_path), method, FIRST + seed)
        expected = learner.reward(reward, observations, actions)
        np.testing.assert_array_equal(r_d(OBSERVATIONS, ACTIONS), expected)
        assert jax.eval_shape(r_d, OBSERVATIONS[0], ACTIONS[0]).shape == ()
    if variant == "a gauge":
        assert float(rewards[0].params.offset) != 0.0


def test_a_reward_that_was_trained_with_another_bound_is_not_that_of_the_default(tmp_path):
    """The mistake that saved parameters alone invite."""
    settings = trainers.with_(reward={"bound": 0.3})
    actors, rewards = drawn("me-ddpg", settings, moved=0.0)
    save(tmp_path, "me-ddpg", settings, stacked(actors), stacked([r.params for r in rewards]))
    found = load_reward(tmp_path, "me-ddpg", FIRST)(OBSERVATIONS, ACTIONS)
    by_default = compose.compose(SPEC, METHODS["me-ddpg"], trainers.SMALL, 100).learner
    state = by_default.init(jax.random.key(0)).replace(params=rewards[0].params)
    expected = 3.0 * np.asarray(by_default.reward(state, OBSERVATIONS, ACTIONS))
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize("method", ["maxent-irl", "deep-maxent-irl"])
def test_tables_of_methods_with_a_model_are_functions_too(tmp_path, method):
    tabular = TabularSettings(states=9, actions=3, steps=2, centres=3)
    settings = Settings(tabular=tabular)
    mdp = jax.jit(lambda: imitation.discretised(pools.ENV, tabular))()
    data = hot_start.data(pools.scripted(3))
    kind = METHODS[method].tabular
    fit = jax.jit(lambda key: imitation.fit(key, mdp, SPEC, data, kind=kind, settings=tabular))
    fitted = [fit(jax.random.key(seed)) for seed in range(SEEDS)]
    tables = np.stack([result.policy.log_probabilities for result in fitted])
    save(tmp_path, method, settings, tables, np.stack([result.reward for result in fitted]))
    act = jax.jit(load_policy(tmp_path, method, FIRST + 1))
    expected = discretise.greedy(mdp, fitted[1].policy.log_probabilities)(OBSERVATIONS)
    np.testing.assert_array_equal(act(OBSERVATIONS), expected)
    # At the points of the grid, the table itself.
    r_d = jax.jit(load_reward(tmp_path, method, FIRST + 1))
    states, actions = interpolation.points(mdp.states), interpolation.points(mdp.actions)
    every = r_d(
        np.broadcast_to(states[:, None], (len(states), len(actions), 2)),
        np.broadcast_to(actions, (len(states), len(actions), 1)),
    )
    np.testing.assert_allclose(every, fitted[1].reward[:-1], rtol=1e-5, atol=1e-6)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Cells of two numbers of demonstrations, of two blocks of seeds, and of two studies."""
    folder = tmp_path_factory.mktemp("run")
    settings = Settings(
        architecture=Architecture(hidden=(2,)),
        reward_network=RewardNetworkSettings(hidden=(2,)),
    )
    actors = stacked(drawn_actors(settings.architecture))

    def policies(scale):
        return jax.tree.map(lambda leaf: scale * leaf, actors)

    save(folder, "ddpg", settings, policies(1.0), None, first_seed=0)
    save(folder, "ddpg", settings, policies(2.0), None, first_seed=SEEDS)
    save(folder, "hs-ddpg", settings, policies(1.0), None, n_demos=1, first_seed=0)
    save(folder, "hs-ddpg", settings, policies(3.0), None, n_demos=10, first_seed=0)
    return folder


def test_a_seed_is_found_in_its_block(run):
    first, later = (load_policy(run, "ddpg", seed)(OBSERVATIONS) for seed in (1, SEEDS + 1))
    assert not np.array_equal(first, later)
    one, ten = (load_policy(run, "hs-ddpg", 1, n_demos=n)(OBSERVATIONS) for n in (1, 10))
    np.testing.assert_array_equal(first, one)
    assert not np.array_equal(one, ten)
    np.testing.assert_array_equal(load_policy(run, "ddpg", 1, study=0)(OBSERVATIONS), first)


def test_what_was_trained_is_loaded_with_other_settings_of_jax(run, tmp_path):
    method, settings = METHODS["me-ddpg"], cells.finished(run)[0].settings()
    learner = compose.compose(SPEC, method, settings, 100).learner
    params = jax.tree.map(
        lambda leaf: np.full((SEEDS, *leaf.shape), 0.5, leaf.dtype),
        jax.eval_shape(learner.init, jax.random.key(0)).params,
    )
    save(tmp_path, method.name, settings, params, params)

    def loaded():
        act, r_d = load_policy(run, "ddpg", 0), load_reward(tmp_path, method.name, FIRST)
        return act(OBSERVATIONS), r_d(OBSERVATIONS, ACTIONS)

    expected = loaded()
    with jax.enable_x64(True), jax.default_prng_impl("rbg"):
        found = loaded()
    chex.assert_trees_all_close(found, expected, rtol=1e-5)
    chex.assert_trees_all_equal_dtypes(found, expected)


THERE = (
    "there are: ddpg, seeds 0 to 2; ddpg, seeds 3 to 5; hs-ddpg, n_demos 1, seeds 0 to 2; "
    "hs-ddpg, n_demos 10, seeds 0 to 2"
)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("ddpg", 6), f"holds no method ddpg, seed 6; {THERE}"),
        (("gail", 0), f"holds no method gail, seed 0; {THERE}"),
        (("hs-ddpg", 0, 5), f"holds no method hs-ddpg, seed 0, n_demos 5; {THERE}"),
        (("ddpg", 0, None, 1), f"holds no method ddpg, seed 0, study 1; {THERE}"),
        (
            ("hs-ddpg", 0),
            "holds several of hs-ddpg, seed 0; give one of: n_demos 1, study 0; "
            "n_demos 10, study 0",
        ),
    ],
)
@pytest.mark.parametrize("load", [load_policy, load_reward])
def test_what_is_missing_or_ambiguous_is_refused_and_says_what_there_is(run, load, arguments, line):
    with pytest.raises(ValueError, match="holds") as refused:
        load(run, *arguments)
    assert str(refused.value) == f"{run}: {line}"


def test_a_method_without_a_reward_says_so(run):
    with pytest.raises(ValueError, match="ddpg learns no reward"):
        load_reward(run, "ddpg", 0)


def test_a_folder_without_cells_says_so(tmp_path):
    for folder in (tmp_path, tmp_path / "nowhere"):
        with pytest.raises(ValueError, match="holds no finished cell of a run"):
            load_policy(folder, "ddpg", 0)


def test_a_damaged_cell_is_refused(run):
    path = run / "cells" / "ddpg-seeds-0-2" / "seeds.parquet"
    content = path.read_bytes()
    path.write_bytes(b"")
    try:
        with pytest.raises(ValueError, match=r"is damaged \(seeds\.parquet\)"):
            load_policy(run, "ddpg", 0)
    finally:
        path.write_bytes(content)


def test_a_cell_of_other_settings_is_refused(tmp_path):
    key = CellKey(0, "none", "ddpg", 0, 0, SEEDS)
    settings = plain.plain(Settings())
    del settings["agent"]["tau"]
    description = {"task": plain.plain(SPEC), "settings": settings}
    cells.save(tmp_path, key, description, cells_of.rows(key), {})
    with pytest.raises(ValueError, match=r"written by a version with other settings \(tau\)"):
        load_policy(tmp_path, "ddpg", 0)
    assert sealing.read(tmp_path / "cells" / "ddpg-seeds-0-2")["settings"] == settings


def test_the_functions_can_be_compiled(run):
    act = load_policy(run, "ddpg", 0)
    np.testing.assert_allclose(
        jax.jit(act)(jnp.asarray(OBSERVATIONS)), act(OBSERVATIONS), rtol=1e-5, atol=1e-6
    )
