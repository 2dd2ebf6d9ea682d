import chex
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from cmedirl_jax import irl
from cmedirl_jax.irl import IRLHParams, regularisers, rewards
from cmedirl_jax.types import Network, RewardBatch
from tests.support import reference
from tests.support.agents import SPEC, random_batch, scaled

SMALL = rewards.mlp(SPEC, hidden=(5, 4))
SMALL = SMALL._replace(init=jax.jit(SMALL.init))


def learner(hparams, **kwargs):
    made = irl.make(SPEC, hparams, **{"network": SMALL, "optimizer": optax.sgd(1.0), **kwargs})
    return made._replace(update=jax.jit(made.update), reward=jax.jit(made.reward))


def batches(demonstrations=7, background=5):
    return (
        random_batch(jax.random.key(1), demonstrations),
        random_batch(jax.random.key(2), background),
    )


def outputs(learned, batch):
    """f at each pair of a batch, in numpy."""
    return reference.mlp(learned, scaled(batch.observation), np.asarray(batch.action))[:, 0]


def squashed(f, by):
    return {"tanh": 0.1 * np.tanh(f), "clip": np.clip(f, -0.1, 0.1), "none": f}[by]


def log_mean_exp(values, weights):
    return np.log(np.mean(weights * np.exp(values)))


@pytest.mark.parametrize("append", [False, True])
@pytest.mark.parametrize("bounded_by", ["tanh", "clip", "none"])
@pytest.mark.parametrize("objective", ["visitation", "transition"])
@pytest.mark.parametrize("absorbing", [False, True])
def test_gradient_equals_finite_differences_of_a_float64_posterior(
    append, bounded_by, objective, absorbing
):
    hparams = IRLHParams(
        output_penalty=0.3,
        prior_precision=0.2,
        bounded_by=bounded_by,
        objective=objective,
        absorbing=absorbing,
        append_demonstrations=append,
    )
    algorithm = learner(hparams)
    before, batches_ = algorithm.init(jax.random.key(0)), batches()
    density = [np.linspace(-1, 1, len(batch.action)) for batch in batches_]
    given = [
        RewardBatch(batch, np.float32(log_b), np.ones(len(log_b), bool))
        for batch, log_b in zip(batches_, density, strict=True)
    ]
    # The last layer starts near zero, where bounded and unbounded rewards are nearly equal.
    params = jax.tree.map(lambda leaf: 3.0 * np.asarray(leaf), before.params.network)
    absorbed = np.float32(0.07) if absorbing else None
    before = before.replace(params=before.params._replace(network=params, absorbing=absorbed))
    after, info = algorithm.update(before, *given)

    def negative_posterior(learned):
        raw, scores = [outputs(learned[0], batch) for batch in batches_], []
        for f, batch, log_b in zip(raw, batches_, density, strict=True):
            r, z = squashed(f, bounded_by), np.exp(-log_b)
            if absorbing:
                ends = np.asarray(batch.terminated)
                r = np.r_[r, np.full(ends.sum(), squashed(learned[1], bounded_by))]
                z = np.r_[z, z[ends]]
            scores.append((r, z))
        (on_demo, _), on_background = scores
        r, z = map(np.concatenate, zip(*scores, strict=True)) if append else on_background
        expected = (z / z.sum()) @ r if objective == "visitation" else log_mean_exp(r, z)
        prior = -0.5 * 0.2 * sum((leaf**2).sum() for leaf in jax.tree.leaves(learned))
        penalty = 0.3 * np.mean(np.concatenate(raw) ** 2)
        if absorbing:
            penalty += 0.3 * learned[1] ** 2
        return -(on_demo.mean() - expected + prior) + penalty

    moved = jax.tree.map(np.subtract, before.params, after.params)
    start = (before.params.network, before.params.absorbing)
    expected = reference.gradient(negative_posterior, start)
    chex.assert_trees_all_close((moved.network, moved.absorbing), expected, rtol=2e-3, atol=2e-6)
    norm = np.sqrt(sum((leaf**2).sum() for leaf in jax.tree.leaves(expected)))
    np.testing.assert_allclose(info.gradient_norm, norm, rtol=1e-3)


def test_trajectories_give_the_gradient_of_a_float64_posterior_absorbing_states_included():
    hparams = IRLHParams(
        objective="trajectory", discount=0.9, absorbing=True, output_penalty=0.3, bounded_by="none"
    )
    algorithm = learner(hparams)
    before = algorithm.init(jax.random.key(0))
    before = before.replace(params=before.params._replace(absorbing=np.float32(0.2)))
    steps = 4
    batches_, masks = [], []
    for seed, lengths in ((1, [4, 2, 3]), (2, [1, 4, 0])):
        flat = jax.device_get(random_batch(jax.random.key(seed), len(lengths) * steps))
        shaped = jax.tree.map(lambda x: x.reshape(-1, steps, *x.shape[1:]), flat)
        mask = np.arange(steps) < np.array(lengths)[:, None]
        last = np.arange(steps) == np.array(lengths)[:, None] - 1
        ended = last & np.array([[True], [True], [False]])
        log_density = np.float32([0.5, -0.3, 0.2])
        masks.append(mask)
        batches_.append(RewardBatch(shaped._replace(terminated=ended), log_density, mask))
    after, info = algorithm.update(before, *batches_)

    def negative_posterior(learned):
        returns, squares = [], []
        for batch, _, mask in batches_:
            flat = jax.tree.map(lambda x: np.asarray(x).reshape(-1, *x.shape[2:]), batch)
            f = outputs(learned[0], flat).reshape(mask.shape)
            squares.append((f**2)[mask])
            ended = (np.asarray(batch.terminated) & mask).any(axis=1)
            f = np.where(mask, f, np.where(ended[:, None], learned[1], 0.0))
            returns.append((f * 0.9 ** np.arange(steps)).sum(axis=1))
        # A trajectory of length 0 is left out.
        r, z = np.r_[returns[0], returns[1][:2]], np.exp(-np.array([0.5, -0.3, 0.2, 0.5, -0.3]))
        value = returns[0].mean() - log_mean_exp(r, z)
        return -value + 0.3 * (np.mean(np.concatenate(squares)) + learned[1] ** 2)

    moved = jax.tree.map(np.subtract, before.params, after.params)
    expected = reference.gradient(
        negative_posterior, (before.params.network, before.params.absorbing)
    )
    chex.assert_trees_all_close((moved.network, moved.absorbing), expected, rtol=2e-3, atol=2e-6)
    assert 1.0 < info.effective_sample_size < 5.0


def test_the_gradient_penalty_is_taken_between_the_batches_and_needs_a_key():
    plain, penalised = (learner(IRLHParams(gradient_penalty=weight)) for weight in (None, 0.5))
    batches_ = batches()
    with pytest.raises(ValueError, match="pass a key"):
        penalised.update(penalised.init(jax.random.key(0)), *batches_)
    key = jax.random.key(3)
    state = plain.init(jax.random.key(0))
    with_penalty = state.replace(hparams=penalised.init(key).hparams)
    moves = [
        jax.tree.map(
            np.subtract, before.params, algorithm.update(before, *batches_, key=key)[0].params
        )
        for algorithm, before in ((plain, state), (penalised, with_penalty))
    ]
    pairs = [(batch.observation, batch.action) for batch in batches_]
    half_widths = np.float32([0.9, 0.07]), np.float32([1.0])

    @jax.jit
    @jax.grad
    def of_penalty(params):
        between = regularisers.interpolate(key, *pairs)
        return 0.5 * regularisers.gradient_penalty(
            lambda s, a: SMALL.apply(params, s, a), *between, np.ones(5, bool), scale=half_widths
        )

    expected = of_penalty(state.params.network)
    difference = jax.tree.map(np.subtract, moves[1].network, moves[0].network)
    chex.assert_trees_all_close(difference, expected, rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("gauge", ["zero-mean", "demonstration-maximum"])
def test_the_gauge_follows_its_batches_and_is_subtracted_from_every_reward(gauge):
    algorithm = learner(IRLHParams(gauge=gauge, gauge_rate=0.25, absorbing=True))
    state, (demonstrations, background) = algorithm.init(jax.random.key(0)), batches()
    bare = state.replace(params=state.params._replace(offset=np.float32(0.0)))
    on = [algorithm.reward(bare, b.observation, b.action) for b in (demonstrations, background)]
    target = np.mean(on[1]) if gauge == "zero-mean" else np.max(on[0])
    after, _ = algorithm.update(state, demonstrations, background)
    np.testing.assert_allclose(after.params.offset, 0.25 * target, rtol=1e-5)
    lifted = np.float32(1.0) + np.asarray(after.params.offset)
    lifted = after.replace(params=after.params._replace(offset=lifted))
    pair = demonstrations.observation, demonstrations.action
    np.testing.assert_allclose(
        algorithm.reward(lifted, *pair), np.asarray(algorithm.reward(after, *pair)) - 1.0, atol=1e-6
    )
    assert algorithm.absorbing(lifted) == pytest.approx(algorithm.absorbing(after) - 1.0)


def test_with_one_hot_features_the_gradient_is_the_difference_in_visits():
    """Eq. 6 in its tabular form: r = theta^T phi with phi the indicator of a cell."""
    cells = 4

    def apply(params, observation, action):
        cell = jnp.clip((action[..., 0] + 1.0) * 0.5 * cells, 0, cells - 1).astype(int)
        return params[cell]

    network = Network(lambda key: jnp.zeros(cells), apply)
    algorithm = learner(
        IRLHParams(bounded_by="none", output_penalty=0.0, append_demonstrations=False),
        network=network,
    )
    demonstrations, background = batches(40, 60)
    after, _ = algorithm.update(algorithm.init(jax.random.key(0)), demonstrations, background)

    def visits(batch):
        return np.histogram(np.asarray(batch.action), bins=cells, range=(-1, 1))[0] / len(
            batch.action
        )

    expected = visits(demonstrations) - visits(background)
    np.testing.assert_allclose(after.params.network, expected, atol=1e-6)


def test_appending_the_demonstrations_only_rescales_the_data_term():
    demonstrations, background = batches(6, 18)
    moves = []
    for append in (False, True):
        algorithm = learner(IRLHParams(output_penalty=0.0, append_demonstrations=append))
        before = algorithm.init(jax.random.key(0))
        after, _ = algorithm.update(before, demonstrations, background)
        moves.append(jax.tree.map(np.subtract, after.params, before.params))
    rescaled = jax.tree.map(lambda leaf: leaf * 18 / 24, moves[0])
    chex.assert_trees_all_close(moves[1], rescaled, rtol=1e-3, atol=1e-7)


def test_the_reward_stays_within_its_bound_however_long_it_learns():
    algorithm = irl.make(SPEC, IRLHParams(bound=0.1, output_penalty=0.0, learning_rate=1e-2))
    demonstrations, background = batches(32, 32)

    def step(state, _):
        return algorithm.update(state, demonstrations, background)

    @jax.jit
    def learn(key):
        state, info = jax.lax.scan(step, algorithm.init(key), length=500)
        return algorithm.reward(state, demonstrations.observation, demonstrations.action), info

    r_d, info = jax.device_get(learn(jax.random.key(0)))
    assert np.abs(r_d).max() <= 0.1
    assert info.demonstration_reward[-1] - info.background_reward[-1] > 0.05


def test_learnt_reward_ranks_demonstrated_actions_first():
    algorithm = irl.make(SPEC)
    uniform = jax.device_get(random_batch(jax.random.key(1), 512))
    demonstrations = uniform._replace(action=0.5 * np.sign(uniform.observation[:, 1:]))

    def step(state, key):
        index = jax.random.randint(key, (32,), 0, 512)
        take = jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], (demonstrations, uniform))
        return algorithm.update(state, *take)[0], None

    @jax.jit
    def learn(key):
        state, _ = jax.lax.scan(step, algorithm.init(key), jax.random.split(key, 500))
        return [
            algorithm.reward(state, demonstrations.observation, action)
            for action in (demonstrations.action, -demonstrations.action)
        ]

    better, worse = jax.device_get(learn(jax.random.key(2)))
    assert np.mean(better > worse) > 0.9


def test_batched_states_rates_and_a_second_call():
    algorithm = irl.make(SPEC, network=SMALL)
    state = algorithm.init(jax.random.key(0))
    states = jax.tree.map(lambda leaf: jnp.asarray(np.stack([leaf] * 2)), state)
    states = states.replace(hparams=states.hparams.replace(learning_rate=jnp.array([0.0, 1e-2])))
    update = jax.jit(jax.vmap(algorithm.update, in_axes=(0, None, None)), donate_argnums=0)
    first = jax.tree.map(np.array, states.params.network)
    for _ in range(2):
        states, _ = update(states, *batches())
    assert update._cache_size() == 1
    learnt = jax.device_get(states.params.network)
    pairs = zip(jax.tree.leaves(learnt), jax.tree.leaves(first), strict=True)
    moved = np.any([(new != old).reshape(2, -1).any(axis=1) for new, old in pairs], axis=0)
    assert moved.tolist() == [False, True]


def test_wrong_shapes_are_named():
    algorithm = irl.make(SPEC, network=SMALL)
    state, (demonstrations, background) = algorithm.init(jax.random.key(0)), batches()
    wrong = demonstrations._replace(action=demonstrations.action[:, 0])
    with pytest.raises(ValueError, match=r"demonstrations: expected actions \[B, 1\]"):
        algorithm.update(state, wrong, background)
    with pytest.raises(ValueError, match="background: expected"):
        algorithm.update(state, demonstrations, wrong)
