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


def plain_gradient_descent(hparams=None, **kwargs):
    """An agent whose parameters move by exactly minus the gradient."""
    hparams = hparams or DDPGHParams(pre_activation_penalty=0.1, behaviour_cloning=0.7)
    agent = ddpg.make(
        SPEC,
        hparams,
        networks=SMALL,
        actor_optimizer=optax.sgd(1.0),
        critic_optimizer=optax.sgd(1.0),
        **kwargs,
    )
    return agent._replace(update=jax.jit(agent.update, static_argnames=("update_targets", "clone")))


@pytest.mark.parametrize("q_filter", [False, True])
def test_gradients_equal_finite_differences_of_a_float64_reference(q_filter):
    agent = plain_gradient_descent(
        DDPGHParams(pre_activation_penalty=0.1, behaviour_cloning=0.7, q_filter=q_filter)
    )
    before = agent.init(jax.random.key(0))
    # Targets that differ from the parameters, so that exchanging the two would be noticed.
    target = agent.init(jax.random.key(1))
    before = before.replace(target_actor=target.actor, target_critic=target.critic)
    batch, demonstrations = random_batch(jax.random.key(2), 16), random_batch(jax.random.key(3), 6)
    after, info = agent.update(before, batch, demonstrations)

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
    agent = plain_gradient_descent(DDPGHParams(pre_activation_penalty=0.0))
    before = agent.init(jax.random.key(0))
    batch = random_batch(jax.random.key(1), 8)
    after, _ = agent.update(before, batch)

    @jax.jit
    def ascent():
        action, mu_vjp = jax.vjp(
            lambda actor: agent.act(before.replace(actor=actor), batch.observation), before.actor
        )
        value_slope = jax.vmap(jax.grad(lambda a, s: agent.value(after, s, a)))(
            action, batch.observation
        )
        return mu_vjp(value_slope / 8)[0]

    expected = jax.tree.map(np.add, before.actor, ascent())
    chex.assert_trees_all_close(after.actor, expected, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("printed", [False, True])
def test_only_the_printed_algorithm_bootstraps_at_termination(printed):
    agent = plain_gradient_descent(DDPGHParams(bootstrap_at_termination=printed))
    state, batch = agent.init(jax.random.key(0)), random_batch(jax.random.key(1), 32)
    targets = ddpg.td_targets(SMALL, state, batch)
    equals_reward = np.isclose(targets, batch.reward, atol=1e-6)
    ends = np.asarray(batch.terminated)
    assert not equals_reward[~ends].any()
    assert equals_reward[ends].all() == (not printed)


def test_targets_move_by_tau_only_when_told():
    agent = plain_gradient_descent(DDPGHParams(tau=0.25))
    before, batch = agent.init(jax.random.key(0)), random_batch(jax.random.key(1), 4)
    moved, _ = agent.update(before, batch)
    expected = jax.tree.map(
        lambda new, old: 0.25 * np.asarray(new) + 0.75 * np.asarray(old),
        moved.critic,
        before.target_critic,
    )
    chex.assert_trees_all_close(moved.target_critic, expected, rtol=1e-6)
    kept, _ = agent.update(before, batch, update_targets=False)
    chex.assert_trees_all_equal(kept.target_critic, before.target_critic)
    chex.assert_trees_all_equal(kept.target_actor, before.target_actor)


def test_tau_of_one_copies():
    agent = plain_gradient_descent(DDPGHParams(tau=1.0))
    state, _ = agent.update(agent.init(jax.random.key(0)), random_batch(jax.random.key(1), 4))
    chex.assert_trees_all_close(state.target_actor, state.actor, rtol=0, atol=0)
    chex.assert_trees_all_close(state.target_critic, state.critic, rtol=0, atol=0)


def test_traced_predicates_do_what_python_ones_do_and_stay_branches_under_vmap():
    agent = ddpg.make(SPEC, networks=SMALL)
    states = jax.vmap(agent.init)(jax.random.split(jax.random.key(0), 3))
    each = [random_batch(jax.random.key(seed), 4) for seed in range(1, 4)]
    batches = jax.tree.map(lambda *leaves: np.stack(leaves), *each)

    def update(state, batch, actor, targets, clone):
        predicates = {"update_actor": actor, "update_targets": targets, "clone": clone}
        return agent.update(state, batch, batch, **predicates)

    mapped = jax.vmap(update, in_axes=(0, 0, None, None, None))
    for predicates in itertools.product((False, True), repeat=3):
        traced, _ = jax.jit(mapped)(states, batches, *map(jnp.asarray, predicates))
        static = jax.vmap(lambda *args, predicates=predicates: update(*args, *predicates))
        known, _ = jax.jit(static)(states, batches)
        chex.assert_trees_all_close(traced, known, rtol=1e-5, atol=1e-7)
    jaxpr = jax.make_jaxpr(mapped)(states, batches, *map(jnp.asarray, predicates))
    assert str(jaxpr).count("cond[") == 3


def test_without_cloning_the_demonstrations_change_nothing():
    agent = plain_gradient_descent()
    state = agent.init(jax.random.key(0))
    batch, demonstrations = random_batch(jax.random.key(1), 8), random_batch(jax.random.key(2), 5)
    chex.assert_trees_all_equal(
        agent.update(state, batch, demonstrations, clone=False), agent.update(state, batch)
    )


def test_one_vmapped_seed_gives_what_the_unbatched_update_gives():
    agent = ddpg.make(SPEC)
    state, batch = agent.init(jax.random.key(0)), random_batch(jax.random.key(1), 32)
    alone, info = jax.jit(agent.update)(state, batch)
    first = jax.tree.map(lambda leaf: leaf[None], (state, batch))
    mapped, mapped_info = jax.jit(jax.vmap(agent.update))(*first)
    chex.assert_trees_all_close(
        (alone, info),
        jax.tree.map(lambda leaf: leaf[0], (mapped, mapped_info)),
        rtol=1e-4,
        atol=1e-6,
    )


def test_hyperparameters_are_leaves():
    agent = ddpg.make(SPEC, networks=SMALL)
    states = jax.vmap(agent.init)(jnp.stack([jax.random.key(0)] * 2))
    rates = jnp.array([0.0, 1e-2])
    states = states.replace(hparams=states.hparams.replace(critic_learning_rate=rates))
    batch = random_batch(jax.random.key(1), 8)
    after, _ = jax.jit(jax.vmap(agent.update, in_axes=(0, None)))(states, batch)
    kernel = [state.critic["params"]["Dense_0"]["kernel"] for state in (states, after)]
    change = jnp.abs(kernel[1] - kernel[0]).max((1, 2))
    assert change[0] == 0.0
    assert change[1] > 1e-3


def test_default_optimiser_is_adam_at_the_states_rate():
    ours = ddpg.make(SPEC, networks=SMALL)
    theirs = ddpg.make(
        SPEC, networks=SMALL, actor_optimizer=optax.adam(1e-4), critic_optimizer=optax.adam(1e-3)
    )
    updates = [jax.jit(agent.update) for agent in (ours, theirs)]
    states = [agent.init(jax.random.key(0)) for agent in (ours, theirs)]
    for step in range(3):
        batch = random_batch(jax.random.key(step), 8)
        states = [update(state, batch)[0] for update, state in zip(updates, states, strict=True)]
    for name in ("actor", "critic"):
        first, second = (getattr(state, name) for state in states)
        chex.assert_trees_all_close(first, second, rtol=1e-5, atol=1e-7)


def test_state_can_be_donated_and_a_second_call_does_not_recompile():
    agent = ddpg.make(SPEC)
    update = jax.jit(agent.update, donate_argnums=0)
    state = agent.init(jax.random.key(0))
    for step in range(2):
        state, _ = update(state, random_batch(jax.random.key(step), 32))
    assert update._cache_size() == 1


def test_batch_normalised_networks_train_and_move_their_statistics():
    architecture = Architecture(
        hidden=(8,), actor_normalisation="batch", critic_normalisation="batch"
    )
    hparams = DDPGHParams(behaviour_cloning=0.7)
    agent = ddpg.make(SPEC, hparams, networks=networks.make(SPEC, architecture))
    before, batch = agent.init(jax.random.key(0)), random_batch(jax.random.key(1), 32)
    after, _ = jax.jit(agent.update)(before, batch)
    for name in ("actor", "critic"):
        old, new = (getattr(state, name)["batch_stats"] for state in (before, after))
        assert all(jax.tree.leaves(jax.tree.map(lambda a, b: bool((a != b).any()), old, new)))
    # The behaviour-cloning term must not move running statistics.
    cloned, _ = jax.jit(agent.update)(before, batch, random_batch(jax.random.key(2), 8))
    chex.assert_trees_all_close(
        cloned.actor["batch_stats"], after.actor["batch_stats"], rtol=1e-5, atol=1e-7
    )


@pytest.mark.parametrize("field", Transition._fields)
def test_wrong_shapes_are_named(field):
    agent = ddpg.make(SPEC, networks=SMALL)
    batch = random_batch(jax.random.key(0), 8)
    wrong = batch._replace(**{field: getattr(batch, field)[..., None]})
    with pytest.raises(ValueError, match="batch: expected leaves of shape"):
        agent.update(agent.init(jax.random.key(0)), wrong)
    with pytest.raises(ValueError, match="demonstrations: expected leaves of shape"):
        agent.update(agent.init(jax.random.key(0)), batch, wrong)


def train_on_probe(make_batch, hparams, steps=1500):
    agent = ddpg.make(PROBE, hparams)

    def step(state, key):
        return agent.update(state, make_batch(key))[0], None

    keys = jax.random.split(jax.random.key(1), steps)
    state, _ = jax.jit(lambda state: jax.lax.scan(step, state, keys))(agent.init(jax.random.key(0)))
    return agent, state


def probe_batch(key, observation, reward, next_observation, terminated):
    action = jax.random.uniform(key, (32, 1), minval=-1.0, maxval=1.0)
    column = jnp.ones((32, 1))
    return Transition(
        observation=observation * column,
        action=action,
        reward=reward(action) * jnp.ones(32),
        next_observation=next_observation * column,
        terminated=jnp.broadcast_to(terminated, 32),
    )


def test_probe_one_step_whose_reward_depends_on_the_action():
    agent, state = train_on_probe(
        lambda key: probe_batch(key, 0.0, lambda a: -jnp.square(a[:, 0] - 0.3), 0.0, True),
        DDPGHParams(actor_learning_rate=1e-3),
    )
    np.testing.assert_allclose(agent.act(state, jnp.zeros(1)), 0.3, atol=0.05)
    actions = jnp.linspace(-1.0, 1.0, 9)[:, None]
    values = agent.value(state, jnp.zeros((9, 1)), actions)
    np.testing.assert_allclose(values, -((actions[:, 0] - 0.3) ** 2), atol=0.05)


def test_probe_two_steps_where_the_discount_matters():
    def batch(key):
        first = probe_batch(key, -1.0, lambda a: jnp.zeros(32), 1.0, False)
        second = probe_batch(key, 1.0, lambda a: jnp.ones(32), 1.0, True)
        return jax.tree.map(lambda x, y: jnp.concatenate([x, y]), first, second)

    agent, state = train_on_probe(batch, DDPGHParams(discount=0.6))
    values = agent.value(state, jnp.array([[-1.0], [1.0]]), jnp.zeros((2, 1)))
    np.testing.assert_allclose(values, [0.6, 1.0], atol=0.03)


@pytest.mark.parametrize(("terminated", "value"), [(False, 2.0), (True, 1.0)])
def test_probe_a_time_limit_bootstraps_and_an_end_does_not(terminated, value):
    agent, state = train_on_probe(
        lambda key: probe_batch(key, 0.0, lambda a: jnp.ones(32), 0.0, terminated),
        DDPGHParams(discount=0.5),
    )
    np.testing.assert_allclose(agent.value(state, jnp.zeros(1), jnp.zeros(1)), value, atol=0.05)
