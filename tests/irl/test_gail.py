import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
import scipy.special

from cmedirl_jax.irl import gail, rewards
from cmedirl_jax.irl.gail import GAILHParams
from cmedirl_jax.types import Network, RewardBatch
from tests.support import reference
from tests.support.agents import SPEC, random_batch, scaled

KEY = jax.random.key(0)
SMALL = rewards.mlp(SPEC, hidden=(5, 4))
SMALL = SMALL._replace(init=jax.jit(SMALL.init))
CELLS = 4
# A logit for each quarter of the actions' range.
TABLE = Network(
    lambda key: jnp.zeros(CELLS),
    lambda logits, observation, action: logits[jnp.int32((action[..., 0] + 1.0) * 0.5 * CELLS)],
)
FORMS = {
    "-log(1 - D)": lambda log_d, log_rest: -log_rest,
    "log D": lambda log_d, log_rest: log_d,
    "logit D": lambda log_d, log_rest: log_d - log_rest,
}


def learner(hparams=None, **kwargs):
    parts = {"network": SMALL, "optimizer": optax.sgd(1.0), **kwargs}
    return gail.make(SPEC, hparams, **parts)


ALGORITHM = learner(GAILHParams(scale=0.7, output_penalty=0.3))
update = jax.jit(ALGORITHM.update)


def begun():
    """The last layer starts near zero, where D is a half everywhere."""
    state = ALGORITHM.init(KEY)
    return state.replace(params=jax.tree.map(lambda leaf: 3.0 * np.asarray(leaf), state.params))


def masked(key, size):
    mask = np.arange(size) % 3 > 0
    # A discriminator ignores the samples' densities.
    log_density = np.arange(size, dtype=np.float32)
    return RewardBatch(random_batch(jax.random.key(key), size), log_density, mask)


def logits(params, batch):
    observation, action = batch.transition.observation, np.float64(batch.transition.action)
    return reference.mlp(reference.float64(params), scaled(observation), action)[batch.mask, 0]


def reference_likelihood(params, demonstrations, background):
    told = -np.logaddexp(0.0, -logits(params, demonstrations)).mean()
    return told - np.logaddexp(0.0, logits(params, background)).mean()


def test_gradient_equals_finite_differences_of_a_float64_likelihood():
    demonstrations, background = masked(1, 7), masked(2, 5)
    before = begun()
    after, info = update(before, demonstrations, background)

    def loss(params):
        output = np.r_[logits(params, demonstrations), logits(params, background)]
        value = reference_likelihood(params, demonstrations, background)
        return -value + 0.3 * np.mean(output**2)

    moved = jax.tree.map(np.subtract, before.params, after.params)
    expected = reference.gradient(loss, before.params)
    chex.assert_trees_all_close(moved, expected, rtol=2e-3, atol=2e-6)
    norm = np.sqrt(sum((leaf**2).sum() for leaf in jax.tree.leaves(expected)))
    assert norm > 0.05
    np.testing.assert_allclose(info.gradient_norm, norm, rtol=1e-3)


def test_infos_are_of_the_state_before_the_update():
    demonstrations, background = masked(1, 7), masked(2, 5)
    before = begun()
    _, info = update(before, demonstrations, background)
    rewards = [
        0.7 * np.logaddexp(0.0, logits(before.params, batch)).mean()
        for batch in (demonstrations, background)
    ]
    expected = reference_likelihood(before.params, demonstrations, background)
    np.testing.assert_allclose(info[:2], rewards, rtol=1e-5)
    np.testing.assert_allclose(info.log_likelihood, expected, rtol=1e-5)
    assert info.log_prior == 0
    assert info.effective_sample_size == background.mask.sum()
    assert {leaf.shape for leaf in info} == {()}


def test_masked_entries_do_not_count():
    demonstrations, background = masked(1, 7), masked(2, 5)
    spoilt = jax.tree.map(
        lambda leaf: np.where(
            background.mask.reshape(-1, *[1] * (leaf.ndim - 1)), leaf, np.ones_like(leaf)
        ),
        background.transition,
    )
    updated = update(begun(), demonstrations, background)
    spoilt = update(begun(), demonstrations, background._replace(transition=spoilt))
    chex.assert_trees_all_equal(updated, spoilt)


def pairs(counts):
    """As many actions in the middle of each quarter."""
    middle = (np.arange(CELLS) + 0.5) * 2 / CELLS - 1.0
    action = np.repeat(middle, counts).astype(np.float32)[:, None]
    return random_batch(KEY, len(action))._replace(action=action)


def test_the_optimal_logit_is_that_of_the_densities_ratio():
    demonstrated, sampled = np.array([6, 1, 2, 3]), np.array([1, 5, 2, 4])
    optimum = np.log(demonstrated / 12) - np.log(sampled / 12)
    algorithm = learner(GAILHParams(output_penalty=0.0), network=TABLE)
    on_table = jax.jit(algorithm.update)
    for offset, vanishes in ((np.zeros(CELLS), True), (np.array([0.1, 0, 0, -0.1]), False)):
        state = algorithm.init(KEY).replace(params=jnp.float32(optimum + offset))
        _, info = on_table(state, pairs(demonstrated), pairs(sampled))
        assert (info.gradient_norm < 1e-6) == vanishes


@pytest.mark.parametrize("form", FORMS)
def test_rewards_are_functions_of_the_discriminator(form):
    logit = np.float32([-50.0, -2.0, 0.3, 50.0])
    algorithm = learner(GAILHParams(scale=0.7, form=form), network=TABLE)
    state = algorithm.init(KEY).replace(params=jnp.asarray(logit))
    batch = pairs(np.ones(CELLS, int))
    reward = jax.jit(algorithm.reward)(state, batch.observation, batch.action)
    log_d, log_rest = (scipy.special.log_expit(sign * np.float64(logit)) for sign in (1, -1))
    expected = 0.7 * FORMS[form](log_d, log_rest)
    np.testing.assert_allclose(reward, expected, rtol=1e-5)
    signs = {"-log(1 - D)": {1.0}, "log D": {-1.0}, "logit D": {-1.0, 1.0}}
    assert set(np.sign(expected)) == signs[form]


def test_descent_learns_to_tell_the_two_apart():
    algorithm = gail.make(SPEC, GAILHParams(output_penalty=0.0), network=TABLE)
    demonstrated, sampled = np.array([6, 1, 2, 3]), np.array([1, 5, 2, 4])
    batches = pairs(demonstrated), pairs(sampled)

    def learn(state):
        return jax.lax.scan(lambda state, _: algorithm.update(state, *batches), state, length=300)

    states = jax.vmap(algorithm.init)(jnp.stack([KEY, KEY]))
    states = states.replace(hparams=states.hparams.replace(learning_rate=jnp.array([0.0, 0.1])))
    states, _ = jax.jit(jax.vmap(learn))(states)
    optimum = np.log(demonstrated / sampled)
    np.testing.assert_allclose(states.params, [np.zeros(CELLS), optimum], atol=1e-2)


def test_wrong_shapes_are_named():
    state, batch = begun(), random_batch(KEY, 5)
    wrong = batch._replace(action=batch.action[:, 0])
    with pytest.raises(ValueError, match=r"demonstrations: expected actions \[B, 1\]"):
        ALGORITHM.update(state, wrong, batch)
    with pytest.raises(ValueError, match="background: expected actions"):
        ALGORITHM.update(state, batch, wrong)
