import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmedirl_jax import irl, rewards
from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.types import Network
from tests import reference
from tests.test_ddpg import SPEC, random_batch, scaled

SMALL = rewards.mlp(SPEC, hidden=(5, 4))


def learner(hparams, **kwargs):
    return irl.make(SPEC, hparams, **{"network": SMALL, "optimizer": optax.sgd(1.0), **kwargs})


def batches(demonstrations=7, background=5):
    return (
        random_batch(jax.random.key(1), demonstrations),
        random_batch(jax.random.key(2), background),
    )


@pytest.mark.parametrize("append", [False, True])
@pytest.mark.parametrize("bound", [0.1, np.inf])
def test_gradient_equals_finite_differences_of_a_float64_posterior(append, bound):
    hparams = IRLHParams(
        bound=bound, output_penalty=0.3, prior_precision=0.2, append_demonstrations=append
    )
    algorithm = learner(hparams)
    before, (demonstrations, background) = algorithm.init(jax.random.key(0)), batches()
    # The last layer begins near zero, where bounded and unbounded rewards cannot be told apart.
    before = before.replace(params=jax.tree.map(lambda leaf: 3.0 * leaf, before.params))
    after, info = jax.jit(algorithm.update)(before, demonstrations, background)

    def output(params, batch):
        return reference.mlp(params, scaled(batch.observation), np.asarray(batch.action))[:, 0]

    def negative_posterior(params):
        on_demo, on_background = output(params, demonstrations), output(params, background)
        everything = np.r_[on_demo, on_background]

        def reward(f):
            return f if np.isinf(bound) else bound * np.tanh(f)

        samples = everything if append else on_background
        data = reward(on_demo).mean() - reward(samples).mean()
        prior = -0.5 * 0.2 * sum((leaf**2).sum() for leaf in jax.tree.leaves(params))
        return -(data + prior) + 0.3 * np.mean(everything**2)

    moved = jax.tree.map(jnp.subtract, before.params, after.params)
    expected = reference.gradient(negative_posterior, before.params)
    chex.assert_trees_all_close(moved, expected, rtol=2e-3, atol=2e-6)
    norm = np.sqrt(sum((leaf**2).sum() for leaf in jax.tree.leaves(expected)))
    np.testing.assert_allclose(info.gradient_norm, norm, rtol=1e-3)


def test_with_one_hot_features_the_gradient_is_the_difference_in_visits():
    """Eq. 6 in its tabular form: r = theta^T phi with phi the indicator of a cell."""
    cells = 4

    def apply(params, observation, action):
        cell = jnp.clip((action[..., 0] + 1.0) * 0.5 * cells, 0, cells - 1).astype(int)
        return params[cell]

    network = Network(lambda key: jnp.zeros(cells), apply)
    algorithm = learner(
        IRLHParams(bound=np.inf, output_penalty=0.0, append_demonstrations=False), network=network
    )
    demonstrations, background = batches(40, 60)
    after, _ = algorithm.update(algorithm.init(jax.random.key(0)), demonstrations, background)

    def visits(batch):
        return np.histogram(np.asarray(batch.action), bins=cells, range=(-1, 1))[0] / len(
            batch.action
        )

    expected = visits(demonstrations) - visits(background)
    np.testing.assert_allclose(after.params, expected, atol=1e-6)


def test_appending_the_demonstrations_only_rescales_the_data_term():
    demonstrations, background = batches(6, 18)
    moves = []
    for append in (False, True):
        algorithm = learner(IRLHParams(output_penalty=0.0, append_demonstrations=append))
        before = algorithm.init(jax.random.key(0))
        after, _ = algorithm.update(before, demonstrations, background)
        moves.append(jax.tree.map(jnp.subtract, after.params, before.params))
    rescaled = jax.tree.map(lambda leaf: leaf * 18 / 24, moves[0])
    chex.assert_trees_all_close(moves[1], rescaled, rtol=1e-3, atol=1e-7)


def test_the_reward_stays_within_its_bound_however_long_it_learns():
    algorithm = irl.make(SPEC, IRLHParams(bound=0.1, output_penalty=0.0, learning_rate=1e-2))
    demonstrations, background = batches(32, 32)

    def step(state, _):
        return algorithm.update(state, demonstrations, background)

    state, info = jax.jit(lambda s: jax.lax.scan(step, s, length=500))(
        algorithm.init(jax.random.key(0))
    )
    r_d = algorithm.reward(state, demonstrations.observation, demonstrations.action)
    assert jnp.abs(r_d).max() <= 0.1
    assert info.demonstration_reward[-1] - info.background_reward[-1] > 0.1


def test_learnt_reward_ranks_demonstrated_actions_first():
    algorithm = irl.make(SPEC)
    uniform = random_batch(jax.random.key(1), 512)
    demonstrations = uniform._replace(action=0.5 * jnp.sign(uniform.observation[:, 1:]))

    def step(state, key):
        index = jax.random.randint(key, (32,), 0, 512)
        take = jax.tree.map(lambda leaf: leaf[index], (demonstrations, uniform))
        return algorithm.update(state, *take)[0], None

    keys = jax.random.split(jax.random.key(2), 500)
    state, _ = jax.jit(lambda s: jax.lax.scan(step, s, keys))(algorithm.init(jax.random.key(0)))
    opposite = -demonstrations.action
    better = algorithm.reward(
        state, demonstrations.observation, demonstrations.action
    ) > algorithm.reward(state, demonstrations.observation, opposite)
    assert better.mean() > 0.9


def test_batched_states_rates_and_a_second_call():
    algorithm = irl.make(SPEC, network=SMALL)
    states = jax.vmap(algorithm.init)(jnp.stack([jax.random.key(0)] * 2))
    states = states.replace(hparams=states.hparams.replace(learning_rate=jnp.array([0.0, 1e-2])))
    update = jax.jit(jax.vmap(algorithm.update, in_axes=(0, None, None)), donate_argnums=0)
    first = jax.tree.map(np.asarray, states.params)
    for _ in range(2):
        states, _ = update(states, *batches())
    assert update._cache_size() == 1
    pairs = zip(jax.tree.leaves(states.params), jax.tree.leaves(first), strict=True)
    moved = np.any([(new != old).reshape(2, -1).any(axis=1) for new, old in pairs], axis=0)
    assert moved.tolist() == [False, True]


def test_wrong_shapes_are_named():
    algorithm = irl.make(SPEC, network=SMALL)
    state, (demonstrations, background) = algorithm.init(jax.random.key(0)), batches()
    wrong = demonstrations._replace(action=demonstrations.action[:, 0])
    with pytest.raises(ValueError, match=r"demonstrations: expected .* \[B, 1\]"):
        algorithm.update(state, wrong, background)
    with pytest.raises(ValueError, match="background: expected"):
        algorithm.update(state, demonstrations, wrong)
