import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import irl, tabular
from cmedirl_jax.irl import IRLHParams, objectives
from cmedirl_jax.irl.objectives import Scored
from cmedirl_jax.types import EnvSpec, Network, RewardBatch, Transition
from tests.support import mdps


def random_scored(rng, size, *, keep=0.7):
    """Rewards, weights (some of them zero) and a mask that keeps at least one entry."""
    log_weight = np.where(rng.random(size) < 0.2, -np.inf, rng.normal(size=size))
    mask = rng.random(size) < keep
    mask[0], log_weight[0] = True, 0.5
    return Scored(rng.normal(size=size), log_weight, mask)


@functools.partial(jax.jit, static_argnums=(0, 3))
def differences(objective, demonstrations, background, append):
    """dL/dr of both batches, and the estimate."""

    def value(on_demonstrations, on_background):
        likelihood = objective(
            demonstrations._replace(reward=on_demonstrations),
            background._replace(reward=on_background),
            append=append,
        )
        return likelihood.value, likelihood

    return jax.grad(value, argnums=(0, 1), has_aux=True)(demonstrations.reward, background.reward)


@pytest.fixture
def float64():
    with jax.enable_x64(True):
        yield


def by_counting(objective, demonstrations, background, append):
    """mu_D - E[mu] on all pairs, the value and the effective sample size, in numpy."""
    both = [np.concatenate(pair) for pair in zip(demonstrations, background, strict=True)]
    reward, log_weight, mask = both
    of_demonstrations = np.arange(len(reward)) < len(demonstrations.reward)
    sampled = mask & (append | ~of_demonstrations)
    z = np.where(sampled, np.exp(np.where(np.isneginf(log_weight), -np.inf, log_weight)), 0.0)
    w = z if objective is objectives.visitation else z * np.exp(reward)
    demonstrated = (mask & of_demonstrations) / (mask & of_demonstrations).sum()
    if objective is objectives.visitation:
        partition = (w / w.sum()) @ reward
    else:
        partition = np.log(w.sum() / sampled.sum())
    expected = demonstrated - w / w.sum()
    return expected, demonstrated @ reward - partition, w.sum() ** 2 / (w**2).sum()


@pytest.mark.parametrize(
    "objective", [objectives.visitation, objectives.transition, objectives.trajectory]
)
@pytest.mark.parametrize("append", [False, True])
def test_the_derivative_by_the_rewards_is_the_difference_in_weighted_visits(
    objective, append, float64
):
    for seed in range(5):
        rng = np.random.default_rng(seed)
        batches = random_scored(rng, 6), random_scored(rng, 9)
        slopes, likelihood = differences(objective, *batches, append)
        expected, value, size = by_counting(objective, *batches, append)
        np.testing.assert_allclose(np.concatenate(slopes), expected, atol=1e-12)
        assert likelihood.value == pytest.approx(value, abs=1e-12)
        assert likelihood.effective_sample_size == pytest.approx(size, rel=1e-12)


@pytest.mark.parametrize("objective", [objectives.visitation, objectives.transition])
def test_without_samples_the_likelihood_and_its_gradient_are_zero(objective):
    demonstrations = Scored(np.ones(2), np.zeros(2), np.ones(2, bool))
    for background in (
        Scored(np.ones(3), np.zeros(3), np.zeros(3, bool)),
        Scored(np.ones(3), np.full(3, -np.inf), np.ones(3, bool)),
    ):
        slopes, likelihood = differences(objective, demonstrations, background, False)
        assert all((np.asarray(slope) == 0).all() for slope in slopes)
        assert (likelihood.value, likelihood.effective_sample_size) == (0.0, 0.0)


def test_without_samples_no_nan_arises_where_it_would_not_be_taken():
    nothing = Scored(jnp.ones(3), jnp.full(3, -jnp.inf), jnp.zeros(3, bool))
    with jax.disable_jit(), jax.debug_nans(True):
        weighed = objectives.weighed(nothing, nothing, append=True, exponent=0.0)
        assert objectives.visitation(*weighed, append=True) == (0.0, 0.0)
        assert objectives.transition(*weighed, append=True) == (0.0, 0.0)


def test_infinite_densities_of_either_sign_have_weight_zero_and_nan_is_kept():
    log_weight = objectives.log_weight(jnp.array([jnp.inf, -jnp.inf, 2.0, -300.0, jnp.nan]))
    np.testing.assert_array_equal(log_weight, [-np.inf, -np.inf, -2.0, 300.0, np.nan])


weigh = jax.jit(objectives.weighed, static_argnames="append")
some_weights = st.lists(
    st.floats(-500, 500, width=32) | st.just(float("-inf")), min_size=1, max_size=6
)


@given(some_weights, some_weights, st.booleans(), st.floats(0, 2), st.floats(0.1, 30))
def test_weights_are_tempered_and_clipped_about_the_mean_of_all_samples(
    first, second, append, exponent, limit
):
    padded = [np.float32([*weights, *[0.0] * (6 - len(weights))]) for weights in (first, second)]
    masks = [np.arange(6) < len(weights) for weights in (first, second)]
    batches = [
        Scored(np.zeros(6, np.float32), log_weight, mask)
        for log_weight, mask in zip(padded, masks, strict=True)
    ]
    weighed = jax.device_get(weigh(*batches, append=append, exponent=exponent, limit=limit))
    used = [
        exponent * log_weight[mask & np.isfinite(log_weight)].astype(np.float64)
        for log_weight, mask in zip(padded, masks, strict=True)
    ]
    samples = np.concatenate(used if append else used[1:])
    centre = samples.mean() if samples.size else 0.0
    for scored, log_weight, mask, own in zip(weighed, padded, masks, used, strict=True):
        kept = mask & np.isfinite(log_weight)
        expected = np.clip(own, centre - limit, centre + limit)
        np.testing.assert_allclose(scored.log_weight[kept], expected, rtol=1e-4, atol=1e-3)
        assert np.isneginf(scored.log_weight[np.isneginf(log_weight)]).all()


@pytest.mark.parametrize("weighted", [False, True])
def test_the_transition_objective_is_stationary_at_its_closed_form_optimum(weighted, float64):
    """r = log(rho_D / mixture) + c, or with z = 1 / b_mix(a|s), r = log(rho_D / mixture(s)) + c."""
    demonstrated = np.array([[4, 1], [2, 3], [5, 1]])  # How often each (s, a) is in the batch.
    sampled = np.array([[1, 7], [6, 2], [2, 6]])
    mixture = (demonstrated + sampled) / (demonstrated + sampled).sum()
    of_state = mixture.sum(axis=1, keepdims=True)
    rho = demonstrated / demonstrated.sum()
    optimum = np.log(rho / (of_state if weighted else mixture)) + 0.3
    log_density = np.log(mixture / of_state) if weighted else np.zeros((3, 2))

    def scored(counts, reward):
        cell = np.repeat(np.arange(6), counts.ravel())
        log_weight = objectives.log_weight(log_density.ravel()[cell])
        return Scored(reward.ravel()[cell], log_weight, np.ones(len(cell), bool))

    @jax.jit
    @jax.grad
    def slopes(reward):
        return objectives.transition(
            scored(demonstrated, reward), scored(sampled, reward), append=True
        ).value

    at_optimum, elsewhere = (slopes(r) for r in (optimum, 0.9 * optimum))
    np.testing.assert_allclose(at_optimum, 0.0, atol=1e-12)
    assert np.abs(elsewhere).max() > 1e-3


# A small problem for the trajectory objective: deterministic, one start, undiscounted.
STATES, ACTIONS, HORIZON, ABSORBING = 4, 2, 4, 3
FOLLOWS = np.array([[1, 2], [2, 3], [0, 3], [3, 3]])
DYNAMICS, ENDS = np.eye(STATES)[FOLLOWS], np.arange(STATES) == ABSORBING
REWARD = np.random.default_rng(0).normal(size=(STATES, ACTIONS))
START = np.eye(STATES)[0]
SPEC = EnvSpec(
    id="Tabular-v0",
    observation_dim=STATES,
    action_dim=ACTIONS,
    observation_low=np.zeros(STATES, np.float32),
    observation_high=np.ones(STATES, np.float32),
    action_low=np.zeros(ACTIONS, np.float32),
    action_high=np.ones(ACTIONS, np.float32),
    max_episode_steps=HORIZON,
    reward_threshold=0.0,
)
TABLE = Network(
    lambda key: jnp.asarray(REWARD, jnp.float32),
    lambda table, observation, action: jnp.einsum("...s,sa,...a->...", observation, table, action),
)


def simulate(key, policy, count):
    """`count` trajectories under `policy` [S, A], as a batch with the densities they have."""
    follows = jnp.asarray(FOLLOWS)
    log_policy = jnp.log(jnp.asarray(policy))

    def step(state, key):
        action = jax.random.categorical(key, log_policy[state])
        running = state != ABSORBING
        return follows[state, action], (state, action, log_policy[state, action], running)

    def one(key):
        return jax.lax.scan(step, 0, jax.random.split(key, HORIZON))[1]

    state, action, log_density, mask = jax.vmap(one)(jax.random.split(key, count))
    nothing = jnp.zeros(mask.shape)
    transition = Transition(
        jax.nn.one_hot(state, STATES),
        jax.nn.one_hot(action, ACTIONS),
        nothing,
        jnp.zeros((*mask.shape, STATES)),
        nothing.astype(bool),
    )
    return RewardBatch(transition, jnp.sum(jnp.where(mask, log_density, 0.0), axis=-1), mask)


UNIFORM = np.full((STATES, ACTIONS), 1 / ACTIONS)
DEMONSTRATOR = np.tile([0.8, 0.2], (STATES, 1))


def exact_gradient():
    """mu_D - E[mu] by dynamic programming, mu_D in the demonstrator's population."""
    policy = tabular.soft_value_iteration(
        DYNAMICS, jnp.asarray(REWARD), discount=1.0, horizon=HORIZON, absorbing=ENDS
    )
    visits = [
        mdps.counted_visits(
            mdps.trajectories(DYNAMICS, np.asarray(each), START, ENDS), 1.0, REWARD.shape
        )
        for each in (np.tile(DEMONSTRATOR, (HORIZON, 1, 1)), np.exp(policy.log_probabilities))
    ]
    return visits[0] - visits[1]


MOST = 1024


@jax.jit
@functools.partial(jax.vmap, in_axes=(0, None))
def sampled_gradients(key, count):
    """The learner's estimates from `count` trajectories of each kind, without and with `append`."""
    batches = []
    for each, policy in zip(jax.random.split(key), (DEMONSTRATOR, UNIFORM), strict=True):
        batch = simulate(each, policy, MOST)
        # What is left out is a trajectory of length zero.
        batches.append(batch._replace(mask=batch.mask & (jnp.arange(MOST)[:, None] < count)))
    estimates = []
    for append in (False, True):
        hparams = IRLHParams(
            objective="trajectory",
            bounded_by="none",
            output_penalty=0.0,
            append_demonstrations=append,
        )
        learner = irl.make(SPEC, hparams, network=TABLE, optimizer=optax.sgd(1.0))
        state = learner.init(key)
        given = map(with_mixture_density, batches) if append else batches
        moved, _ = learner.update(state, *given)
        estimates.append(moved.params.network - state.params.network)
    return jnp.stack(estimates)


def with_mixture_density(batch):
    """With half of the trajectories from the demonstrator and half from the uniform policy."""

    def under(policy):
        chosen = jnp.einsum(
            "mts,sa,mta->mt",
            batch.transition.observation,
            jnp.log(jnp.asarray(policy, jnp.float32)),
            batch.transition.action,
        )
        return jnp.sum(jnp.where(batch.mask, chosen, 0.0), axis=-1)

    mixed = jnp.logaddexp(under(UNIFORM), under(DEMONSTRATOR)) - jnp.log(2.0)
    return batch._replace(log_density=mixed)


def test_the_trajectory_estimates_converge_to_the_exact_gradient_as_one_over_root_n():
    exact = exact_gradient()
    sizes, errors = (16, 128, MOST), []
    for size in sizes:
        keys = jax.random.split(jax.random.key(size), 100)
        gradients = np.asarray(sampled_gradients(keys, size))  # [100, append, S, A]
        errors.append(np.sqrt(np.mean((gradients - exact) ** 2, axis=(0, 2, 3))))
        bias = np.abs(gradients.mean(axis=0) - exact).max()
    slopes = np.polyfit(np.log(sizes), np.log(errors), 1)[0]
    np.testing.assert_allclose(slopes, -0.5, atol=0.06, rtol=0)
    assert (errors[-1] < 0.03).all()
    assert bias < 0.01


def test_a_discounted_return_counts_the_steps_of_the_mask():
    rng = np.random.default_rng(0)
    reward, mask = rng.normal(size=(3, 5)).astype(np.float32), rng.random((3, 5)) < 0.6
    expected = (np.where(mask, reward, 0.0) * 0.9 ** np.arange(5)).sum(axis=1)
    returns = jax.jit(objectives.returns)(reward, mask, 0.9)
    np.testing.assert_allclose(returns, expected, rtol=1e-5)
