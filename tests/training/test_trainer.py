import functools

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

# Settings that several tests share: each is a program to compile.
LARGE = {"bound": 50.0, "absorbing": True}
RECOMPUTED = with_(reward=LARGE, reward_schedule={"storage": "recompute", "stop": 0})
STORED = with_(reward=LARGE, reward_schedule={"storage": "store", "stop": 0})
LEARNED = with_(
    reward={"bound": 50.0},
    reward_schedule={"storage": "store", "period": 5, "iterations": 3, "stop": 30},
)
RARE = with_(agent={"tau": 1.0}, schedule={"update_period": 4, "target_period": 7})
FROZEN = with_(agent={"behaviour_cloning": 5.0}, schedule={"frozen_actor_steps": 25})


def stored(state, steps):
    return replay.unpack(ENV.spec, np.asarray(state.storage)[:steps])


def changed(old, new):
    """Whether each leaf differs anywhere."""
    pairs = zip(*map(jax.tree.leaves, (old, new)), strict=True)
    return [bool((np.asarray(a) != np.asarray(b)).any()) for a, b in pairs]


@functools.cache
def whole(method):
    """A chunk of 40 steps at once, its state donated."""
    return jax.jit(compiled(method)[0].run, donate_argnums=0)


@functools.cache
def advanced(method, settings=SMALL):
    """The trainer, and the state and the log after 40 steps."""
    trainer, state, advance = start(method, settings)
    return trainer, *advance(state, 0, LIMIT)


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
    _, state, advance = start(method)
    pool = data() if METHODS[method].uses_demonstrations else None
    stepwise, joined = advance(state, 0, 40)
    at_once, log = whole(method)(jax.tree.map(jnp.copy, state), pool, np.arange(40))
    chex.assert_trees_all_close(stepwise.agent, at_once.agent, rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(stepwise.storage, at_once.storage, rtol=1e-4, atol=1e-6)
    chex.assert_trees_all_close(joined, log, rtol=1e-4, atol=1e-5)


def test_a_seed_does_not_depend_on_its_neighbours_or_their_grouping():
    trainer, _, advance = start("hs-me-ddpg")
    alone = trainer.init(jax.random.fold_in(jax.random.key(3), 7), data(), 3)

    def train(key, data):
        return trainer.run(trainer.init(key, data, 3), data, jnp.arange(40))

    def numbers(state, log):
        return jax.tree.map(np.asarray, (state.agent, state.storage, log))

    def in_groups(keys, group):
        return numbers(*jax.jit(seeds.map_groups(train, group))(keys, data()))

    keys = seeds.keys(jax.random.key(3), 30)
    ten = in_groups(keys[:10], 5)
    elsewhere = in_groups(keys[np.r_[20:22, 7, 22:25]], 3)
    seventh, again = (
        jax.tree.map(lambda leaf, slot=slot: leaf[slot], result)
        for result, slot in ((ten, 7), (elsewhere, 2))
    )
    chex.assert_trees_all_close(seventh, again, rtol=1e-3, atol=1e-5)
    chex.assert_trees_all_close(seventh, numbers(*advance(alone, 0, 40)), rtol=1e-3, atol=1e-5)
    _, storage, _ = ten
    assert not np.allclose(storage[6], storage[7])


def test_the_reward_is_learned_every_period_until_it_stops():
    _, state, advance = start("me-ddpg", LEARNED)
    moved = []
    for step in range(40):
        after, _ = advance(state, step, step + 1)
        moved.append(any(changed(state.reward, after.reward)))
        state = after
    assert np.flatnonzero(moved).tolist() == [10, 15, 20, 25]


def test_iterations_is_the_k_of_algorithm_1():
    """Adam counts its updates."""
    _, state, _ = advanced("me-ddpg", LEARNED)
    assert state.reward.optimizer.count == 4 * 3


@pytest.mark.parametrize(("settings", "share"), [(RECOMPUTED, 0.0), (STORED, 1.0)])
def test_recomputing_stores_the_environments_reward_and_storing_the_shaped_one(settings, share):
    trainer, state, log = advanced("me-ddpg", settings)
    rows = stored(state, LIMIT)
    environment = -0.1 * rows.action[:, 0] ** 2
    learned = trainer.algorithm.learner.reward(state.reward, rows.observation, rows.action)
    assert np.abs(learned).min() > 1e-4
    np.testing.assert_allclose(rows.reward, environment + share * learned, rtol=1e-4, atol=1e-5)
    # Episodes are judged by the environment's reward alone.
    np.testing.assert_allclose(log.episode_return[-1], environment.sum(), rtol=1e-4)


def test_the_reward_learns_before_its_value_is_stored():
    """Algorithm 2's order, with one update at step 10."""
    trainer, state, advance = start("me-ddpg", LEARNED)
    before = state.reward
    state, _ = advance(state, 0, 15)
    rows = stored(state, 15)
    learned = np.asarray(rows.reward) + 0.1 * rows.action[:, 0] ** 2
    old, new = (
        np.asarray(trainer.algorithm.learner.reward(reward, rows.observation, rows.action))
        for reward in (before, state.reward)
    )
    assert np.abs(new - old).min() > 1e-6
    np.testing.assert_allclose(learned[:10], old[:10], rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(learned[10:], new[10:], rtol=1e-3, atol=1e-6)


def test_storing_and_recomputing_a_frozen_reward_learn_the_same():
    agents = [advanced("me-ddpg", settings)[1].agent for settings in (RECOMPUTED, STORED)]
    chex.assert_trees_all_close(*agents, rtol=1e-3, atol=1e-5)


def test_a_fully_annealed_reward_leaves_plain_ddpg():
    _, annealed, _ = advanced("me-ddpg", with_(reward_schedule={"anneal_steps": 1}))
    _, plain, _ = advanced("ddpg")
    chex.assert_trees_all_close(annealed.agent, plain.agent, rtol=1e-3, atol=1e-5)


@pytest.mark.parametrize("settings", [RECOMPUTED, LEARNED])
def test_the_reward_reaches_the_critic(settings):
    _, shaped, _ = advanced("me-ddpg", settings)
    _, unshaped, _ = advanced("ddpg")
    assert any(changed(shaped.agent.critic, unshaped.agent.critic))


@pytest.mark.parametrize(
    ("shaping", "inputs"),
    [("additive", "state-action"), ("alone", "state-action"), ("potential", "state")],
)
def test_r_star_is_stored_as_the_shaping_says(shaping, inputs):
    settings = STORED
    if shaping != "additive":
        settings = with_(
            STORED,
            reward={"bound": 2.0, "absorbing": shaping != "potential"},
            reward_schedule={"shaping": shaping},
            reward_network={"inputs": inputs},
        )
    trainer, state, _ = advanced("me-ddpg", settings)
    # Nothing is learned in the first ten steps: both act alike.
    found = stored(state, 10)
    r_e = stored(advanced("ddpg")[1], 10).reward
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
    assert all(changed(before.reward.params.network, after.reward.params.network))


@pytest.mark.parametrize("method", ["gail", "random-reward", "ddpg-plus-constant"])
def test_rewards_that_do_not_learn_stay_and_a_discriminator_does_not(method):
    _, before, advance = start(method)
    after, log = advance(before, 0, 30)
    moved = changed(before.reward.params, after.reward.params)
    assert all(moved) if method == "gail" else not any(moved)
    assert (log.reward is None) == (method != "gail")


def test_the_behaviour_cloning_term_fades_out_or_stays():
    actors = []
    for schedule in ({"behaviour_cloning_steps": 1}, {"cloning": "none"}, {"cloning": "constant"}):
        _, state, advance = start("hs-ddpg", with_(FROZEN, schedule=schedule))
        actors.append(advance(state, 0, 60)[0].agent.actor)
    chex.assert_trees_all_close(actors[0], actors[1], rtol=1e-3, atol=1e-5)
    pairs = zip(*map(jax.tree.leaves, actors[1:]), strict=True)
    assert any(np.abs(np.asarray(a) - b).max() > 1e-4 for a, b in pairs)


def test_a_hot_started_actor_can_be_frozen_while_the_critic_learns():
    _, before, advance = start("hs-ddpg", with_(FROZEN, schedule={"cloning": "constant"}))
    frozen, log = advance(before, 0, 25)
    assert log.learned[10:].all()
    chex.assert_trees_all_equal(frozen.agent.actor, before.agent.actor)
    after, _ = advance(frozen, 25, 50)
    assert all(changed(before.agent.critic, frozen.agent.critic))
    assert all(changed(frozen.agent.actor, after.agent.actor))


def test_only_a_frozen_actor_compiles_a_branch():
    def branches(method, frozen_actor_steps):
        settings = with_(schedule={"frozen_actor_steps": frozen_actor_steps})
        _, state, _ = start(method, settings)
        pool = None if state.subset is None else data()
        run = compiled(method, settings)[2]
        return str(run.trace(state, pool, np.arange(1, dtype=np.int32), None).jaxpr).count("cond[")

    assert branches("ddpg", 25) == branches("ddpg", 0)
    assert branches("hs-ddpg", 25) == branches("hs-ddpg", 0) + 1


def test_targets_are_copied_by_the_first_update_of_every_period():
    _, state, advance = start("ddpg", RARE, capacity=30)
    copied = []
    for step in range(30):
        after, _ = advance(state, step, step + 1)
        if any(changed(state.agent.target_critic, after.agent.target_critic)):
            copied.append(step)
            chex.assert_trees_all_close(after.agent.target_critic, after.agent.critic)
        state = after
    # Updates at 12, 16, 20, 24 and 28.
    assert copied == [16, 24, 28]


def test_update_period():
    _, state, advance = start("ddpg", RARE, capacity=30)
    _, log = advance(state, 0, 30)
    assert np.flatnonzero(log.learned).tolist() == [12, 16, 20, 24, 28]


def test_a_seed_learns_nothing_after_its_last_episode():
    # The selection that keeps the parameters keeps the statistics beside them.
    architecture = {"actor_normalisation": "batch", "critic_normalisation": "batch"}
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
    _, state, advance = start("ddpg", RARE, capacity=30)
    state, _ = advance(state, 0, 45)
    rows = replay.unpack(ENV.spec, np.asarray(state.storage))
    # Steps 30-44 lie in rows 0-14, steps 15-29 in the rest.
    in_order = np.r_[15:30, 0:15]
    observation, following = rows.observation[in_order], rows.next_observation[in_order]
    breaks = np.flatnonzero((following[:-1] != observation[1:]).any(axis=1))
    assert breaks.tolist() == [LIMIT - 15 - 1]


def test_a_second_chunk_does_not_recompile_and_calls_no_host():
    _, state, _ = start("hs-me-ddpg")
    run, state = whole("hs-me-ddpg"), jax.tree.map(jnp.copy, state)
    for begin in (0, 40, 80):
        state, _ = run(state, data(), np.arange(begin, begin + 40))
    assert run._cache_size() == 1
    program = run.lower(state, data(), np.arange(40)).as_text()
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
    _, state, _ = start(method, settings)
    states = jax.eval_shape(lambda one: jax.tree.map(lambda x: jnp.stack([x, x]), one), state)
    run = jax.vmap(compiled(method, settings)[2], in_axes=(0, None, None, None))
    jaxpr = jax.make_jaxpr(run)(states, data(), np.arange(1, dtype=np.int32), None)
    (call,) = [equation for equation in jaxpr.eqns if equation.params.get("name") == "_run"]
    equations = call.params["jaxpr"].eqns
    (scan,) = [equation for equation in equations if equation.primitive.name == "scan"]
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
    kernels = (each.agent.critic["params"]["Dense_0"]["kernel"] for each in (state, after))
    assert any(changed(*kernels))


def test_an_episode_that_the_task_does_not_end_ends_at_the_specifications_limit():
    endless = ENV._replace(default_params=ENV.default_params.replace(max_episode_steps=10**6))
    trainer = training.make(endless, METHODS["ddpg"], SMALL, capacity=100)
    state = trainer.init(jax.random.key(0), None, 0)
    state, log = jax.jit(trainer.run)(state, None, jnp.arange(2 * LIMIT + 1))
    np.testing.assert_array_equal(np.flatnonzero(log.done), [LIMIT - 1, 2 * LIMIT - 1])
    assert not log.terminated.any()
    # The next episode begins anew, also in the task's own clock.
    assert state.env.time == 1
    assert not stored(state, 2 * LIMIT).terminated.any()
