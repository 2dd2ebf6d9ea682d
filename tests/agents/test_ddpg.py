import functools
import itertools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmedirl_jax import networks
from cmedirl_jax.agents import ddpg
from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.networks import Architecture
from cmedirl_jax.types import Transition
from tests.support import reference
from tests.support.agents import (
    PROBE,
    SMALL,
    SPEC,
    random_batch,
    reference_pre_activation,
    reference_q,
)

# By exactly minus the gradient, with a state that counts its steps.
PLAIN = optax.sgd(lambda count: 1.0)
AGENT = ddpg.make(SPEC, networks=SMALL, actor_optimizer=PLAIN, critic_optimizer=PLAIN)
# The hyperparameters are in the state, so agents of any share these programs.
update = jax.jit(AGENT.update, static_argnames=("update_actor", "update_targets", "clone"))
draw = jax.jit(lambda key: (SMALL.actor.init(key), SMALL.critic.init(jax.random.fold_in(key, 1))))


def initial(hparams=None, seed=0):
    agent = ddpg.make(SPEC, hparams, networks=SMALL, actor_optimizer=PLAIN, critic_optimizer=PLAIN)
    key = jax.random.key(seed)
    return agent.init(key, draw(key))


def batches(seed=2):
    """A batch, and demonstrations."""
    return random_batch(jax.random.key(seed), 16), random_batch(jax.random.key(seed + 1), 6)


@pytest.mark.parametrize("q_filter", [False, True])
def test_gradients_equal_finite_differences_of_a_float64_reference(q_filter):
    before = initial(
        DDPGHParams(pre_activation_penalty=0.1, behaviour_cloning=0.7, q_filter=q_filter)
    )
    # Targets that differ from the parameters, so that exchanging the two would be noticed.
    target = initial(seed=1)
    before = before.replace(target_actor=target.actor, target_critic=target.critic)
    batch, demonstrations = batches()
    after, info = update(before, batch, demonstrations)

    next_action = np.tanh(
        reference_pre_activation(reference.float64(before.target_actor), batch.next_observation)
    )
    next_q = reference_q(
        reference.float64(before.target_critic), batch.next_observation, next_action
    )
    y = np.asarray(batch.reward) + 0.99 * ~np.asarray(batch.terminated) * next_q

    def critic_loss(critic):
        return np.mean((y - reference_q(critic, batch.observation, batch.action)) ** 2)

    def prefers(actor):
        critic = reference.float64(after.critic)
        observation, action = demonstrations.observation, demonstrations.action
        imitated = np.tanh(reference_pre_activation(actor, observation))
        return reference_q(critic, observation, action) > reference_q(critic, observation, imitated)

    def actor_loss(actor):
        z = reference_pre_activation(actor, batch.observation)
        q = reference_q(reference.float64(after.critic), batch.observation, np.tanh(z))
        imitated = np.tanh(reference_pre_activation(actor, demonstrations.observation))
        squared = (imitated - np.asarray(demonstrations.action)) ** 2
        if q_filter:
            # Nair et al. 2018: zeros where the actor's own action is valued as highly or higher.
            squared[~prefers(actor)] = 0.0
        return -q.mean() + 0.1 * np.mean(z**2) + 0.7 * np.mean(squared)

    assert 0 < prefers(reference.float64(before.actor)).sum() < 6

    for loss, old, new in (
        (critic_loss, before.critic, after.critic),
        (actor_loss, before.actor, after.actor),
    ):
        moved = jax.tree.map(lambda old, new: np.asarray(old) - np.asarray(new), old, new)
        chex.assert_trees_all_close(moved, reference.gradient(loss, old), rtol=2e-3, atol=2e-5)
    np.testing.assert_allclose(info.critic_loss, critic_loss(before.critic), rtol=1e-4)
    np.testing.assert_allclose(info.actor_loss, actor_loss(before.actor), rtol=1e-4)


def test_actor_gradient_is_the_deterministic_policy_gradient():
    """Eq. 3: the chain rule through the action, written out."""
    before, (batch, _) = initial(DDPGHParams(pre_activation_penalty=0.0)), batches()
    after, _ = update(before, batch)

    @jax.jit
    def ascent():
        action, mu_vjp = jax.vjp(
            lambda actor: AGENT.act(before.replace(actor=actor), batch.observation), before.actor
        )
        value_slope = jax.vmap(jax.grad(lambda a, s: AGENT.value(after, s, a)))(
            action, batch.observation
        )
        return mu_vjp(value_slope / 16)[0]

    expected = jax.tree.map(np.add, before.actor, ascent())
    chex.assert_trees_all_close(after.actor, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("printed", [False, True])
def test_only_the_printed_algorithm_bootstraps_at_termination(printed):
    state, (batch, _) = initial(DDPGHParams(bootstrap_at_termination=printed)), batches()
    targets = jax.jit(functools.partial(ddpg.td_targets, SMALL))(state, batch)
    equals_reward = np.isclose(targets, batch.reward, atol=1e-6)
    ends = np.asarray(batch.terminated)
    assert not equals_reward[~ends].any()
    assert equals_reward[ends].all() == (not printed)


def test_targets_move_by_tau_only_when_told():
    before, data = initial(DDPGHParams(tau=0.25)), batches()
    moved, _ = update(before, *data)
    expected = jax.tree.map(
        lambda new, old: 0.25 * np.asarray(new) + 0.75 * np.asarray(old),
        moved.critic,
        before.target_critic,
    )
    chex.assert_trees_all_close(moved.target_critic, expected, rtol=1e-6)
    kept, _ = update(before, *data, update_targets=False)
    chex.assert_trees_all_equal(kept.target_critic, before.target_critic)
    chex.assert_trees_all_equal(kept.target_actor, before.target_actor)


def test_tau_of_one_copies():
    state, _ = update(initial(DDPGHParams(tau=1.0)), *batches())
    chex.assert_trees_all_close(state.target_actor, state.actor, rtol=0, atol=0)
    chex.assert_trees_all_close(state.target_critic, state.critic, rtol=0, atol=0)


def test_traced_predicates_do_what_python_ones_do_and_stay_branches_under_vmap():
    names = ("update_actor", "update_targets", "clone")
    hparams = DDPGHParams(behaviour_cloning=0.7)
    each = [(initial(hparams, seed), batches(seed)) for seed in range(3)]
    stacked = jax.tree.map(lambda *leaves: np.stack(leaves), *each)

    def updated(state, data, *predicates):
        return AGENT.update(state, *data, **dict(zip(names, predicates, strict=True)))

    mapped = jax.jit(jax.vmap(updated, in_axes=(0, 0, None, None, None)))
    traced = mapped.trace(*stacked, *map(np.bool_, (True, True, True)))
    assert str(traced.jaxpr).count("cond[") == 3
    run = traced.lower().compile()
    for predicates in itertools.product((False, True), repeat=3):
        result, _ = run(*stacked, *map(np.bool_, predicates))
        # Cloning is a part of the actor's update.
        static = dict(zip(names, predicates, strict=True)) | {"clone": all(predicates[::2])}
        known = [update(state, *data, **static)[0] for state, data in each]
        known = jax.tree.map(lambda *leaves: np.stack(leaves), *known)
        chex.assert_trees_all_close(result, known, rtol=1e-5, atol=1e-7)
    state, data = each[0]
    frozen = [update(state, *data, update_actor=False, clone=clone) for clone in (False, True)]
    chex.assert_trees_all_equal(*frozen)


def test_without_cloning_the_demonstrations_change_nothing():
    state, (batch, demonstrations) = initial(DDPGHParams(behaviour_cloning=0.7)), batches()
    without = update(state, batch)
    chex.assert_trees_all_equal(update(state, batch, demonstrations, clone=False), without)


def test_one_vmapped_seed_gives_what_the_unbatched_update_gives():
    state, (batch, _) = initial(), batches()
    first = jax.tree.map(lambda leaf: np.asarray(leaf)[None], (state, batch))
    mapped = jax.jit(jax.vmap(AGENT.update))(*first)
    chex.assert_trees_all_close(
        update(state, batch),
        jax.tree.map(lambda leaf: np.asarray(leaf)[0], mapped),
        rtol=1e-4,
        atol=1e-6,
    )


def test_hyperparameters_are_leaves():
    agent = ddpg.make(SPEC, networks=SMALL)
    key = jax.random.key(0)
    states = jax.tree.map(lambda leaf: np.stack([leaf] * 2), agent.init(key, draw(key)))
    rates = np.float32([0.0, 1e-2])
    states = states.replace(hparams=states.hparams.replace(critic_learning_rate=rates))
    after, _ = jax.jit(jax.vmap(agent.update, in_axes=(0, None)))(states, batches()[0])
    kernel = [np.asarray(state.critic["params"]["Dense_0"]["kernel"]) for state in (states, after)]
    change = abs(kernel[1] - kernel[0]).max((1, 2))
    assert change[0] == 0.0
    assert change[1] > 1e-3


def test_default_optimiser_is_adam_at_the_rate_of_a_donated_state():
    ours = ddpg.make(SPEC, networks=SMALL)
    theirs = ddpg.make(
        SPEC, networks=SMALL, actor_optimizer=optax.adam(1e-4), critic_optimizer=optax.adam(1e-3)
    )
    updates = [jax.jit(agent.update, donate_argnums=0) for agent in (ours, theirs)]
    key = jax.random.key(0)
    states = [agent.init(key, draw(key)) for agent in (ours, theirs)]
    for step in range(3):
        batch = random_batch(jax.random.key(step), 16)
        states = [update(state, batch)[0] for update, state in zip(updates, states, strict=True)]
    # The second call does not compile again.
    assert updates[0]._cache_size() == 1
    for name in ("actor", "critic"):
        first, second = (getattr(state, name) for state in states)
        chex.assert_trees_all_close(first, second, rtol=1e-5, atol=1e-7)


def test_batch_normalised_networks_train_and_move_their_statistics():
    architecture = Architecture(
        hidden=(8,), actor_normalisation="batch", critic_normalisation="batch"
    )
    hparams = DDPGHParams(behaviour_cloning=0.7)
    agent = ddpg.make(SPEC, hparams, networks=networks.make(SPEC, architecture))
    before, (batch, demonstrations) = jax.jit(agent.init)(jax.random.key(0)), batches()
    update = jax.jit(agent.update)
    after, _ = update(before, batch)
    for name in ("actor", "critic"):
        old, new = (
            jax.device_get(getattr(state, name)["batch_stats"]) for state in (before, after)
        )
        assert all(jax.tree.leaves(jax.tree.map(lambda a, b: (a != b).any(), old, new)))
    # The behaviour-cloning term must not move running statistics.
    cloned, _ = update(before, batch, demonstrations)
    chex.assert_trees_all_close(
        cloned.actor["batch_stats"], after.actor["batch_stats"], rtol=1e-5, atol=1e-7
    )


@pytest.mark.parametrize("field", Transition._fields)
def test_wrong_shapes_are_named(field):
    batch, _ = batches()
    wrong = batch._replace(**{field: np.asarray(getattr(batch, field))[..., None]})
    with pytest.raises(ValueError, match="batch: expected leaves of shape"):
        AGENT.update(initial(), wrong)
    with pytest.raises(ValueError, match="demonstrations: expected leaves of shape"):
        AGENT.update(initial(), batch, wrong)


OBSERVATIONS = np.float32([[-1.0], [0.0], [1.0]])
ACTIONS = np.linspace(-1.0, 1.0, 9, dtype=np.float32)[:, None]


@pytest.fixture(scope="module")
def probes():
    """Actions `[3]` and values `[3, 9]` learnt on each probe, from batches of two kinds of step."""
    kinds = {
        # observations, next ones, terminated, rewards, reward by action, discount, actor's rate
        "one step": ([0, 0], [0, 0], [True, True], [0, 0], -1, 0.99, 1e-3),
        "two steps": ([-1, 1], [1, 1], [False, True], [0, 1], 0, 0.6, 1e-4),
        "time limit": ([0, 0], [0, 0], [False, False], [1, 1], 0, 0.5, 1e-4),
        "end": ([0, 0], [0, 0], [True, True], [1, 1], 0, 0.5, 1e-4),
    }
    agent = ddpg.make(PROBE)

    def train(observation, next_observation, terminated, reward, by_action, discount, rate):
        def step(state, key):
            action = jax.random.uniform(key, (32, 1), minval=-1.0, maxval=1.0)
            rewards = jnp.repeat(reward, 16) + by_action * jnp.square(action[:, 0] - 0.3)
            batch = Transition(
                observation=jnp.repeat(observation, 16)[:, None],
                action=action,
                reward=rewards,
                next_observation=jnp.repeat(next_observation, 16)[:, None],
                terminated=jnp.repeat(terminated, 16),
            )
            return agent.update(state, batch)[0], None

        state = agent.init(jax.random.key(0))
        hparams = state.hparams.replace(discount=discount, actor_learning_rate=rate)
        keys = jax.random.split(jax.random.key(1), 1500)
        state, _ = jax.lax.scan(step, state.replace(hparams=hparams), keys)
        pairs = jnp.broadcast_arrays(OBSERVATIONS[:, None], ACTIONS)
        return agent.act(state, OBSERVATIONS)[:, 0], agent.value(state, *pairs)

    columns = (np.array(column) for column in zip(*kinds.values(), strict=True))
    numbers = [column if column.dtype == bool else np.float32(column) for column in columns]
    trained = jax.jit(jax.vmap(train))(*numbers)
    return dict(zip(kinds, zip(*jax.device_get(trained), strict=True), strict=True))


def test_probe_one_step_whose_reward_depends_on_the_action(probes):
    actions, values = probes["one step"]
    np.testing.assert_allclose(actions[1], 0.3, atol=0.05)
    np.testing.assert_allclose(values[1], -((ACTIONS[:, 0] - 0.3) ** 2), atol=0.05)


def test_probe_two_steps_where_the_discount_matters(probes):
    _, values = probes["two steps"]
    np.testing.assert_allclose(values[[0, 2], 4], [0.6, 1.0], atol=0.03)


@pytest.mark.parametrize(("kind", "value"), [("time limit", 2.0), ("end", 1.0)])
def test_probe_a_time_limit_bootstraps_and_an_end_does_not(probes, kind, value):
    _, values = probes[kind]
    np.testing.assert_allclose(values[1, 4], value, atol=0.05)
