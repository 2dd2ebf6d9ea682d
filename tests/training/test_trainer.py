import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import training
from cmedirl_jax.data import replay
from cmedirl_jax.training import seeds
from cmedirl_jax.training.methods import METHODS
from tests.support.trainers import ENV, LIMIT, SMALL, compiled, data, start, with_


def stored(state, steps):
    return replay.unpack(ENV.spec, np.asarray(state.storage)[:steps])


def test_the_replay_holds_the_episodes_as_they_happened():
    _, state, advance = start("ddpg")
    first = state.observation
    state, log = advance(state, 0, 100)
    rows = stored(state, 100)
    np.testing.assert_array_equal(np.flatnonzero(log.done), [39, 79])
    np.testing.assert_array_equal(rows.observation[0], first)
    follows = (rows.next_observation[:-1] == rows.observation[1:]).all(axis=1)
    np.testing.assert_array_equal(follows, ~np.asarray(log.done)[:-1])
    # A time limit is no termination: it must bootstrap.
    assert not rows.terminated.any()
    np.testing.assert_allclose(log.episode_return[39], rows.reward[:40].sum(), rtol=1e-5)
    np.testing.assert_allclose(log.episode_return[79], rows.reward[40:80].sum(), rtol=1e-5)
    np.testing.assert_array_equal(np.asarray(log.episode_length)[[39, 79, 99]], [40, 40, 20])
    np.testing.assert_allclose(rows.reward, -0.1 * rows.action[:, 0] ** 2, rtol=1e-5)
    assert state.episode == 2


def test_no_update_before_learning_starts():
    _, before, advance = start("ddpg")
    after, log = advance(before, 0, 10)
    chex.assert_trees_all_equal(after.agent, before.agent)
    assert not log.learned.any()
    after, log = advance(after, 10, 20)
    assert log.learned.all()
    assert (log.critic_loss > 0).all()


@pytest.mark.parametrize("method", ["ddpg", "hs-me-ddpg"])
def test_how_steps_are_cut_into_chunks_does_not_matter(method):
    trainer, state, advance = start(method)
    pool = data() if METHODS[method].uses_demonstrations else None
    whole, log = jax.jit(trainer.run)(state, pool, jnp.arange(40))
    state, joined = advance(state, 0, 40)
    chex.assert_trees_all_close(state.agent, whole.agent, rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(state.storage, whole.storage, rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(joined, log, rtol=1e-4, atol=1e-5)


def test_a_seed_does_not_depend_on_its_neighbours_or_their_grouping():
    trainer, _, advance = start("hs-me-ddpg")
    _, init, _ = compiled("hs-me-ddpg")
    alone = init(jax.random.fold_in(jax.random.key(3), 7), data(), 3)

    def train(key, data):
        return trainer.run(trainer.init(key, data, 3), data, jnp.arange(40))

    def all_of(count, group):
        keys = seeds.keys(jax.random.key(3), count)
        return jax.jit(seeds.map_groups(train, group))(keys, data())

    ten, thirty = all_of(10, 5), all_of(30, 10)
    numbers = lambda result: (result[0].agent, result[0].storage, result[1])  # noqa: E731
    seventh = [jax.tree.map(lambda leaf: leaf[7], numbers(r)) for r in (ten, thirty)]
    chex.assert_trees_all_close(*seventh, rtol=1e-3, atol=1e-5)
    chex.assert_trees_all_close(seventh[0], numbers(advance(alone, 0, 40)), rtol=1e-3, atol=1e-5)
    others = jax.tree.map(lambda leaf: leaf[6], ten[0].storage)
    assert not np.allclose(others, ten[0].storage[7])


def test_the_reward_is_learned_every_period_until_it_stops():
    settings = with_(reward_schedule={"period": 5, "stop": 30})
    _, state, advance = start("me-ddpg", settings)
    moved = []
    for step in range(40):
        after, _ = advance(state, step, step + 1)
        pairs = zip(*map(jax.tree.leaves, (state.reward, after.reward)), strict=True)
        moved.append(any((old != new).any() for old, new in pairs))
        state = after
    assert np.flatnonzero(moved).tolist() == [10, 15, 20, 25]


def test_iterations_is_the_k_of_algorithm_1():
    """Adam counts its updates."""
    settings = with_(reward_schedule={"period": 10, "iterations": 3})
    _, state, advance = start("me-ddpg", settings)
    state, _ = advance(state, 0, 35)
    assert state.reward.optimizer.count == 3 * 3


def test_recomputing_stores_the_environments_reward_and_storing_the_shaped_one():
    frozen = {"stop": 0}
    for storage in ("recompute", "store"):
        settings = with_(reward_schedule={"storage": storage, **frozen}, reward={"bound": 50.0})
        trainer, state, advance = start("me-ddpg", settings)
        state, log = advance(state, 0, LIMIT)
        rows = stored(state, LIMIT)
        environment = -0.1 * rows.action[:, 0] ** 2
        learned = trainer.algorithm.learner.reward(state.reward, rows.observation, rows.action)
        assert np.abs(learned).min() > 1e-4
        expected = environment + (learned if storage == "store" else 0.0)
        np.testing.assert_allclose(rows.reward, expected, rtol=1e-4, atol=1e-5)
        # Episodes are judged by the environment's reward alone.
        np.testing.assert_allclose(log.episode_return[-1], environment.sum(), rtol=1e-4)


def test_the_reward_learns_before_its_value_is_stored():
    """Algorithm 2's order, with one update at step 10."""
    settings = with_(
        reward_schedule={"storage": "store", "period": 10, "stop": 11}, reward={"bound": 50.0}
    )
    trainer, state, advance = start("me-ddpg", settings)
    before = state.reward
    state, _ = advance(state, 0, 20)
    rows = stored(state, 20)
    learned = np.asarray(rows.reward) + 0.1 * rows.action[:, 0] ** 2
    old, new = (
        np.asarray(trainer.algorithm.learner.reward(reward, rows.observation, rows.action))
        for reward in (before, state.reward)
    )
    assert np.abs(new - old).min() > 1e-6
    np.testing.assert_allclose(learned[:10], old[:10], rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(learned[10:], new[10:], rtol=1e-3, atol=1e-6)


def test_storing_and_recomputing_a_frozen_reward_learn_the_same():
    agents = []
    for storage in ("recompute", "store"):
        settings = with_(reward_schedule={"storage": storage, "stop": 0})
        _, state, advance = start("me-ddpg", settings)
        agents.append(advance(state, 0, 40)[0].agent)
    chex.assert_trees_all_close(*agents, rtol=1e-3, atol=1e-5)


def test_a_fully_annealed_reward_leaves_plain_ddpg():
    _, state, advance = start("me-ddpg", with_(reward_schedule={"anneal_steps": 1}))
    _, plain, plain_advance = start("ddpg")
    agents = advance(state, 0, 40)[0].agent, plain_advance(plain, 0, 40)[0].agent
    chex.assert_trees_all_close(*agents, rtol=1e-3, atol=1e-5)


def test_the_learned_reward_reaches_the_critic():
    _, state, advance = start("me-ddpg", with_(reward={"bound": 50.0}))
    _, plain, plain_advance = start("ddpg")
    shaped, _ = advance(state, 0, 40)
    unshaped, _ = plain_advance(plain, 0, 40)
    pairs = zip(*map(jax.tree.leaves, (shaped.agent.critic, unshaped.agent.critic)), strict=True)
    assert any((a != b).any() for a, b in pairs)


@pytest.mark.parametrize(
    ("shaping", "inputs"),
    [("additive", "state-action"), ("alone", "state-action"), ("potential", "state")],
)
def test_r_star_is_stored_as_the_shaping_says(shaping, inputs):
    settings = with_(
        reward={"bound": 2.0, "absorbing": shaping != "potential"},
        reward_schedule={"shaping": shaping, "storage": "store", "stop": 0},
        reward_network={"inputs": inputs},
    )
    trainer, state, advance = start("me-ddpg", settings)
    _, plain, plain_advance = start("ddpg")
    # Nothing is learned in the first ten steps: both act alike.
    found = stored(advance(state, 0, 40)[0], 10)
    r_e = stored(plain_advance(plain, 0, 40)[0], 10).reward
    learner = trainer.algorithm.learner
    pairs = found.observation, found.action
    r_d = learner.reward(state.reward, *pairs)
    if shaping == "potential":
        expected = r_e + 0.99 * learner.reward(state.reward, found.next_observation, pairs[1]) - r_d
    else:
        expected = r_d + (r_e if shaping == "additive" else 0.0)
    assert not found.terminated.any()
    assert np.abs(r_d).max() > 1e-5
    np.testing.assert_allclose(found.reward, expected, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize(
    ("objective", "weights"),
    [
        pytest.param("transition", "recorded", marks=pytest.mark.slow),
        ("transition", "fusion"),
        pytest.param("trajectory", "uniform", marks=pytest.mark.slow),
        ("trajectory", "fusion"),
    ],
)
def test_the_objectives_learn_with_their_weights(objective, weights):
    settings = with_(
        exploration={"kind": "gaussian" if objective == "trajectory" else "ornstein-uhlenbeck"},
        reward={"objective": objective, "weight_limit": 3.0, "gradient_penalty": 0.1},
        reward_batches={
            "weights": weights,
            "recent": 50,
            "snapshots": 5,
            "snapshot_period": 10,
            "trajectories": 2,
            "episodes": 2,
        },
        reward_schedule={"period": 20, "iterations": 2},
    )
    _, before, advance = start("me-ddpg", settings)
    after, log = advance(before, 0, 61)
    assert log.reward_learned.sum() == 3
    of_updates = jax.tree.map(lambda leaf: np.asarray(leaf)[[20, 40, 60]], log.reward)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves((of_updates, after.reward)))
    most = 4 if objective == "trajectory" else 16
    size = of_updates.effective_sample_size
    assert ((size > 0.99) & (size <= most + 1e-3)).all()
    # Before the first episode has ended at step 40 the demonstrations are among themselves.
    assert (size[0] <= 2.001) == (objective == "trajectory")
    networks = (before.reward.params.network, after.reward.params.network)
    pairs = zip(*map(jax.tree.leaves, networks), strict=True)
    assert all((a != b).any() for a, b in pairs)


@pytest.mark.parametrize("method", ["gail", "random-reward", "ddpg-plus-constant"])
def test_rewards_that_do_not_learn_stay_and_a_discriminator_does_not(method):
    _, before, advance = start(method)
    after, log = advance(before, 0, 30)
    pairs = zip(*map(jax.tree.leaves, (before.reward.params, after.reward.params)), strict=True)
    same = [bool((a == b).all()) for a, b in pairs]
    assert not any(same) if method == "gail" else all(same)
    assert (log.reward is None) == (method != "gail")


def test_the_behaviour_cloning_term_fades_out_or_stays():
    actors = []
    for schedule in ({"behaviour_cloning_steps": 1}, {"cloning": "none"}, {"cloning": "constant"}):
        settings = with_(agent={"behaviour_cloning": 5.0}, schedule=schedule)
        _, state, advance = start("hs-ddpg", settings)
        actors.append(advance(state, 0, 40)[0].agent.actor)
    chex.assert_trees_all_close(actors[0], actors[1], rtol=1e-3, atol=1e-5)
    pairs = zip(*map(jax.tree.leaves, actors[1:]), strict=True)
    assert any(np.abs(a - b).max() > 1e-4 for a, b in pairs)


def test_a_hot_started_actor_can_be_frozen_while_the_critic_learns():
    _, before, advance = start("hs-ddpg", with_(schedule={"frozen_actor_steps": 25}))
    frozen, log = advance(before, 0, 25)
    assert log.learned[10:].all()
    chex.assert_trees_all_equal(frozen.agent.actor, before.agent.actor)
    after, _ = advance(frozen, 25, 50)

    def moved(old, new):
        return all((a != b).any() for a, b in zip(*map(jax.tree.leaves, (old, new)), strict=True))

    assert moved(before.agent.critic, frozen.agent.critic)
    assert moved(frozen.agent.actor, after.agent.actor)


def test_only_a_frozen_actor_compiles_a_branch():
    def branches(method, frozen_actor_steps):
        settings = with_(schedule={"frozen_actor_steps": frozen_actor_steps})
        trainer = training.make(ENV, METHODS[method], settings, capacity=400)
        pool = data()
        state = jax.eval_shape(lambda key: trainer.init(key, pool, 3), jax.random.key(0))
        return str(jax.make_jaxpr(trainer.run)(state, pool, jnp.arange(5))).count("cond[")

    assert branches("ddpg", 25) == branches("ddpg", 0)
    assert branches("hs-ddpg", 25) == branches("hs-ddpg", 0) + 1


def test_targets_are_copied_every_period():
    settings = with_(agent={"tau": 1.0}, schedule={"target_period": 7})
    _, state, advance = start("ddpg", settings)
    for step in range(25):
        after, _ = advance(state, step, step + 1)
        if step >= 10 and step % 7 == 0:
            chex.assert_trees_all_close(after.agent.target_critic, after.agent.critic)
        else:
            chex.assert_trees_all_equal(after.agent.target_critic, state.agent.target_critic)
        state = after


def test_update_period():
    _, state, advance = start("ddpg", with_(schedule={"update_period": 4}))
    _, log = advance(state, 0, 30)
    assert np.flatnonzero(log.learned).tolist() == [12, 16, 20, 24, 28]


@pytest.mark.parametrize("normalisation", ["layer", "batch"])
def test_a_seed_learns_nothing_after_its_last_episode(normalisation):
    architecture = {"actor_normalisation": normalisation, "critic_normalisation": normalisation}
    _, state, advance = start("me-ddpg", with_(architecture=architecture))
    state, log = advance(state, 0, 2 * LIMIT, 2)
    assert state.episode == 2
    later, log = advance(state, 2 * LIMIT, 4 * LIMIT, 2)
    assert not log.done.any()
    assert later.episode == 2
    for name in ("actor", "critic"):
        chex.assert_trees_all_equal(getattr(later.agent, name), getattr(state.agent, name))
    chex.assert_trees_all_equal(later.reward.params, state.reward.params)


def test_the_replay_wraps_at_its_capacity():
    _, state, advance = start("ddpg", capacity=30)
    state, _ = advance(state, 0, 45)
    rows = replay.unpack(ENV.spec, np.asarray(state.storage))
    # Steps 30-44 lie in rows 0-14, steps 15-29 in the rest.
    in_order = np.r_[15:30, 0:15]
    observation, following = rows.observation[in_order], rows.next_observation[in_order]
    breaks = np.flatnonzero((following[:-1] != observation[1:]).any(axis=1))
    assert breaks.tolist() == [LIMIT - 15 - 1]


def test_a_second_chunk_does_not_recompile_and_calls_no_host():
    trainer, state, _ = start("hs-me-ddpg")
    run = jax.jit(trainer.run, donate_argnums=0)
    state = jax.tree.map(jnp.copy, state)
    for begin in (0, 20, 40):
        state, _ = run(state, data(), jnp.arange(begin, begin + 20))
    assert run._cache_size() == 1
    program = run.lower(state, data(), jnp.arange(20)).as_text()
    assert "callback" not in program


@pytest.mark.parametrize(
    ("method", "objective", "weights"),
    [
        ("hs-me-ddpg", "visitation", "uniform"),
        ("me-ddpg", "transition", "fusion"),
        ("me-ddpg", "trajectory", "recorded"),
        ("gail", "visitation", "uniform"),
    ],
)
def test_branches_stay_branches_under_vmap(method, objective, weights):
    """A predicate that got batched would turn every `cond` into both of its branches."""
    settings = with_(reward={"objective": objective}, reward_batches={"weights": weights})
    trainer = training.make(ENV, METHODS[method], settings, capacity=400)
    pool = data()
    init = jax.vmap(lambda key: trainer.init(key, pool, 3))
    states = jax.eval_shape(init, seeds.keys(jax.random.key(0), 2))
    run = jax.vmap(trainer.run, in_axes=(0, None, None))
    jaxpr = jax.make_jaxpr(run)(states, pool, jnp.arange(5))
    (scan,) = [equation for equation in jaxpr.eqns if equation.primitive.name == "scan"]
    conditionals = [e for e in scan.params["jaxpr"].eqns if e.primitive.name == "cond"]
    # Learning the reward, learning at all.
    assert len(conditionals) == 2


def test_hyperparameters_of_a_running_seed_can_be_changed():
    _, state, advance = start("ddpg")
    hparams = state.agent.hparams.replace(critic_learning_rate=jnp.zeros(()))
    still = state.replace(agent=state.agent.replace(hparams=hparams))
    after, _ = advance(still, 0, 20)
    chex.assert_trees_all_equal(after.agent.critic, state.agent.critic)


def test_a_tabular_reward_is_each_seeds_own_bounded_and_stays():
    settings = with_(tabular={"states": 9, "actions": 3, "steps": 3, "hidden": (8,)})
    _, state, advance = start("tabular-me-ddpg", settings)
    _, other, _ = start("tabular-me-ddpg", settings, key=1)
    table = np.asarray(state.reward.params)
    assert table.shape == (81, 3)
    np.testing.assert_allclose(np.abs(table).max(), settings.reward.bound, rtol=1e-6)
    assert (table != np.asarray(other.reward.params)).any()
    after, log = advance(state, 0, 40)
    np.testing.assert_array_equal(after.reward.params, table)
    assert log.learned.any()
    assert (
        np.asarray(after.agent.critic["params"]["Dense_0"]["kernel"])
        != np.asarray(state.agent.critic["params"]["Dense_0"]["kernel"])
    ).any()


def test_an_episode_that_the_task_does_not_end_ends_at_the_specifications_limit():
    endless = ENV._replace(default_params=ENV.default_params.replace(max_episode_steps=10**6))
    trainer = training.make(endless, METHODS["ddpg"], SMALL, capacity=100)
    state = jax.jit(trainer.init)(jax.random.key(0), None, 0)
    state, log = jax.jit(trainer.run)(state, None, jnp.arange(2 * LIMIT + 1))
    np.testing.assert_array_equal(np.flatnonzero(log.done), [LIMIT - 1, 2 * LIMIT - 1])
    assert not log.terminated.any()
    # The next episode begins anew, also in the task's own clock.
    assert state.env.time == 1
    assert not stored(state, 2 * LIMIT).terminated.any()
