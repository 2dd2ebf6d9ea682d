import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scipy.special
import scipy.stats

from cmedirl_jax import networks
from cmedirl_jax.agents import exploration
from cmedirl_jax.agents.exploration import EpsilonGreedyHParams, OrnsteinUhlenbeckHParams
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data import replay
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.episodes import EpisodesState
from cmedirl_jax.data.replay import ReplayState
from cmedirl_jax.irl import reward_batches
from cmedirl_jax.irl.reward_batches import RewardBatchSettings, SampleDraws
from cmedirl_jax.irl.sample_weights import MixtureState, RecordedState
from cmedirl_jax.networks import Architecture
from cmedirl_jax.types import Transition
from tests.support import reference
from tests.support.agents import SPEC as ENV_SPEC
from tests.support.agents import scaled
from tests.support.episodes import played

KEY = jax.random.key(0)
RNG = np.random.default_rng(0)
SPEC = ENV_SPEC._replace(max_episode_steps=6)
CAPACITY, STEPS, RECENT = 30, 47, 20
SNAPSHOTS, PERIOD, EPISODES = 3, 7, 4
NETWORKS = networks.make(SPEC, Architecture(hidden=(6, 5)))
ACTOR = jax.tree.map(
    lambda leaf: 0.7 * RNG.normal(size=leaf.shape).astype(np.float32),
    jax.eval_shape(NETWORKS.actor.init, KEY),
)
REPLAY = replay.make(SPEC, CAPACITY)
BEHAVIOURS = {
    "ornstein-uhlenbeck": exploration.ornstein_uhlenbeck(SPEC, OrnsteinUhlenbeckHParams(0.3, 0.5)),
    "epsilon-greedy": exploration.epsilon_greedy(
        SPEC, EpsilonGreedyHParams(epsilon_start=0.9, epsilon_end=0.1, epsilon_steps=40, noise=0.4)
    ),
}
DEVIATION = 0.5 / np.sqrt(1.0 - 0.7**2)

OBSERVATIONS = RNG.uniform(SPEC.observation_low, SPEC.observation_high, (STEPS, 2))
ENDED = np.zeros(STEPS, bool)
ENDED[np.cumsum([3, 6, 1, 4, 6, 2, 5, 6, 3, 6])] = True  # The last episode still runs.

POOL = Transition(
    observation=RNG.uniform(SPEC.observation_low, SPEC.observation_high, (24, 2)),
    action=np.clip(RNG.normal(size=(24, 1)), -1.0, 1.0),
    reward=np.arange(24.0),
    next_observation=RNG.uniform(SPEC.observation_low, SPEC.observation_high, (24, 2)),
    terminated=RNG.random(24) < 0.2,
)
POOL = jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else np.float32(leaf), POOL)
# Of five episodes three are the learner's, the pool's last among them, and one is padding.
SUBSET = DemonstrationSubset(np.int32([10, 0, 21, 6]), np.int32([5, 6, 3, 0]))
DRAWS = SampleDraws(
    background=np.random.default_rng(1).integers(0, 2**32, 60, dtype=np.uint32),
    demonstrations=np.random.default_rng(2).choice(np.r_[0:6, 10:15, 21:24], 60).astype(np.int32),
)
WHOLE_DRAWS = DRAWS._replace(demonstrations=np.arange(60, dtype=np.int32) % 3)


def actor_at(step):
    """A policy that changes with every step."""
    return jax.tree.map(lambda leaf: leaf * (1.0 + 0.05 * step), ACTOR)


@functools.cache
def made(weights, objective="visitation", append=True, behaviour="ornstein-uhlenbeck"):
    samples = reward_batches.make(
        SPEC,
        NETWORKS,
        BEHAVIOURS[behaviour],
        REPLAY,
        CAPACITY,
        RewardBatchSettings(
            weights=weights,
            snapshots=SNAPSHOTS,
            snapshot_period=PERIOD,
            episodes=EPISODES,
            recent=RECENT,
        ),
        objective=objective,
        append=append,
    )
    return samples._replace(init=jax.jit(samples.init), take=jax.jit(samples.take))


@functools.cache
def stepper(weights, objective, behaviour):
    acting, record = BEHAVIOURS[behaviour], made(weights, objective, True, behaviour).record

    @jax.jit
    def step(state, storage, noise, number, observation, ended):
        actor = actor_at(number)
        greedy = networks.policy(NETWORKS, actor, observation)
        key = jax.random.fold_in(KEY, number)
        action, log_density, noise = acting.sample(key, noise, greedy, number)
        transition = Transition(
            observation, action, number.astype(jnp.float32), -observation, ended
        )
        storage = REPLAY.add(ReplayState(storage, number), transition).storage
        return record(state, actor, number, log_density, ended), storage, noise, log_density

    return step


@functools.cache
def run(weights, objective="visitation", steps=STEPS, behaviour="ornstein-uhlenbeck"):
    """What is kept, the replay, the noise's state and the log densities, after some steps."""
    state = made(weights, objective, True, behaviour).init(KEY, ACTOR, POOL, SUBSET)
    storage, noise, recorded = REPLAY.init().storage, BEHAVIOURS[behaviour].init(KEY), []
    step = stepper(weights, objective, behaviour)
    for number in range(steps):
        given = np.float32(OBSERVATIONS[number]), ENDED[number]
        state, storage, noise, log_density = step(state, storage, noise, np.int32(number), *given)
        recorded.append(float(log_density))
    return state, ReplayState(storage, jnp.int32(steps)), noise, np.array(recorded)


def take(weights, objective="visitation", append=True, draws=DRAWS, **kwargs):
    state, stored, noise, _ = run(weights, objective, **kwargs)
    samples = made(weights, objective, append, kwargs.get("behaviour", "ornstein-uhlenbeck"))
    return samples.take(state, POOL, SUBSET, stored, noise, draws)


def clipped_normal(mean, deviation, action):
    law = scipy.stats.norm(mean, deviation)
    at = [action <= -1.0, action >= 1.0]
    return np.select(at, [law.logcdf(-1.0), law.logsf(1.0)], law.logpdf(action))[..., 0]


def of_demonstrator(state, transition):
    coefficients, deviation = reference.float64(state.weights.demonstrator)
    mean = coefficients[0] + np.float64(transition.observation) @ coefficients[1:]
    return clipped_normal(mean, deviation, np.float64(transition.action))


def of_snapshots(transition, steps):
    """log q_k(a|s) `[K, ...]` of the latest snapshots after so many steps."""
    taken = range(0, steps, PERIOD)[-SNAPSHOTS:]
    observation, action = scaled(transition.observation), np.float64(transition.action)
    greedy = [
        np.tanh(reference.mlp(reference.float64(actor_at(step)), observation)) for step in taken
    ]
    return np.stack([clipped_normal(mean, DEVIATION, action) for mean in greedy])


def mixed(log_densities):
    return scipy.special.logsumexp(log_densities, axis=0) - np.log(len(log_densities))


def half_and_half(first, second):
    return np.logaddexp(first, second) - np.log(2.0)


def assert_close(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-4)


def assert_equal(found, expected):
    jax.tree.map(np.testing.assert_array_equal, found, expected)


def test_uniform_pairs_are_the_plain_minibatches():
    demonstrations, sampled = take("uniform")
    _, stored, _, _ = run("uniform")
    assert_equal(demonstrations.transition, demonstrations_lib.at(POOL, DRAWS.demonstrations))
    assert_equal(sampled.transition, REPLAY.take(stored, DRAWS.background, RECENT))
    assert sampled.transition.reward.min() == STEPS - RECENT
    for batch in (demonstrations, sampled):
        np.testing.assert_array_equal(batch.log_density, np.zeros(60))
        np.testing.assert_array_equal(batch.mask, np.ones(60, bool))


def test_nothing_is_kept_that_nothing_needs():
    needs = {
        ("uniform", "visitation"): (None, None),
        ("recorded", "transition"): (None, RecordedState),
        ("fusion", "visitation"): (None, MixtureState),
        ("uniform", "trajectory"): (EpisodesState, None),
    }
    for (weights, objective), kept in needs.items():
        state = jax.eval_shape(made(weights, objective).init, KEY, ACTOR, POOL, SUBSET)
        found = [None if part is None else type(part) for part in (state.source, state.weights)]
        assert tuple(found) == kept


def test_the_demonstrator_is_fitted_to_the_subsets_pairs_alone():
    fitted = run("recorded")[0].weights.demonstrator
    own = np.r_[10:15, 0:6, 21:24]
    pairs = np.c_[np.ones(14), np.float64(POOL.observation[own])]
    slopes, squares, *_ = np.linalg.lstsq(pairs, np.float64(POOL.action[own]))
    # Drawn with replacement: as near as 1024 pairs come to the fourteen.
    mean = np.float64(POOL.observation[own]) @ fitted.coefficients[1:] + fitted.coefficients[0]
    np.testing.assert_allclose(mean, pairs @ slopes, atol=0.15)
    np.testing.assert_allclose(fitted.scale, np.sqrt(squares / 14), rtol=0.1)


@pytest.mark.parametrize("steps", [10, STEPS])
def test_recorded_densities_are_those_of_the_very_rows(steps):
    demonstrations, sampled = take("recorded", steps=steps)
    state, _, _, recorded = run("recorded", steps=steps)
    rows = np.int32(sampled.transition.reward)
    np.testing.assert_array_equal(sampled.log_density, np.float32(recorded)[rows])
    assert len(set(recorded)) > 0.9 * steps
    assert_close(demonstrations.log_density, of_demonstrator(state, demonstrations.transition))


@pytest.mark.parametrize("steps", [0, 1, 7, 8, 21, 22, STEPS])
def test_snapshots_are_the_latest_ones_of_every_period(steps):
    snapshots = run("fusion", steps=steps)[0].weights.snapshots
    taken = range(0, steps, PERIOD)[-SNAPSHOTS:]
    expected = [actor_at(step) for step in taken]
    expected += [jax.tree.map(np.zeros_like, ACTOR)] * (SNAPSHOTS - len(taken))
    found = [jax.tree.map(lambda leaf, slot=slot: leaf[slot], snapshots) for slot in range(3)]

    def as_sorted(trees):
        rows = [
            np.concatenate([np.ravel(leaf) for leaf in jax.tree.leaves(tree)]) for tree in trees
        ]
        return np.array(sorted(map(tuple, rows)))

    np.testing.assert_allclose(as_sorted(found), as_sorted(expected), rtol=1e-6)


@pytest.mark.parametrize("append", [False, True])
@pytest.mark.parametrize("steps", [7, 8, STEPS])
def test_fused_densities_are_the_mixtures_of_a_brute_force(steps, append):
    batches = take("fusion", append=append, steps=steps)
    state = run("fusion", steps=steps)[0]
    for batch in batches:
        expected = mixed(of_snapshots(batch.transition, steps))
        if append:
            expected = half_and_half(expected, of_demonstrator(state, batch.transition))
        assert_close(batch.log_density, expected)
        assert batch.mask.all()


@pytest.mark.parametrize("steps", [8, STEPS])
def test_a_snapshot_explores_as_it_did_when_it_was_taken(steps):
    """A falling epsilon is another one in each component of the mixture."""
    _, sampled = take("fusion", append=False, steps=steps, behaviour="epsilon-greedy")
    transition = sampled.transition
    action, observation = np.float64(transition.action), scaled(transition.observation)
    inside = np.abs(action[:, 0]) < 1.0
    components = []
    for step in range(0, steps, PERIOD)[-SNAPSHOTS:]:
        epsilon = 0.9 - 0.8 * min(step / 40, 1.0)
        greedy = np.tanh(reference.mlp(reference.float64(actor_at(step)), observation))
        near = np.exp(clipped_normal(greedy, 0.4, action))
        components.append(epsilon * inside / 2.0 + (1.0 - epsilon) * near)
    assert_close(sampled.log_density, np.log(np.mean(components, axis=0)))


def episodes_held():
    finished, stored = played(ENDED, CAPACITY)
    latest = finished[-EPISODES:]
    assert all(set(episode) <= set(stored) for episode in latest)
    return {episode for episode in latest if episode[0] >= STEPS - RECENT}


def numbers(batch):
    """The transitions of each trajectory, in order."""
    rewards = np.int32(batch.transition.reward)
    return [tuple(row[mask]) for row, mask in zip(rewards, np.asarray(batch.mask), strict=True)]


@pytest.mark.parametrize("weights", ["uniform", "recorded", "fusion"])
def test_trajectories_are_whole_episodes_in_order(weights):
    demonstrations, sampled = take(weights, "trajectory", draws=WHOLE_DRAWS)
    assert set(numbers(sampled)) == episodes_held()
    chosen = [SUBSET.start[which] for which in WHOLE_DRAWS.demonstrations]
    lengths = [SUBSET.length[which] for which in WHOLE_DRAWS.demonstrations]
    expected = [tuple(range(a, a + n)) for a, n in zip(chosen, lengths, strict=True)]
    assert numbers(demonstrations) == expected
    for batch, pool in ((demonstrations, POOL.observation), (sampled, np.float32(OBSERVATIONS))):
        assert batch.mask.shape == (60, 6)
        assert batch.log_density.shape == (60,)
        assert np.all(np.diff(np.int32(batch.mask)) <= 0)
        steps = np.int32(batch.transition.reward)[batch.mask]
        np.testing.assert_array_equal(batch.transition.observation[batch.mask], pool[steps])


def test_uniform_trajectories_weigh_alike():
    for batch in take("uniform", "trajectory", draws=WHOLE_DRAWS):
        np.testing.assert_array_equal(batch.log_density, np.zeros(60))


def summed(log_density, mask):
    return np.where(mask, log_density, 0.0).sum(axis=-1)


def test_a_trajectorys_recorded_density_is_the_sum_over_its_steps():
    demonstrations, sampled = take("recorded", "trajectory", draws=WHOLE_DRAWS)
    state, _, _, recorded = run("recorded", "trajectory")
    expected = [recorded[list(episode)].sum() for episode in numbers(sampled)]
    assert_close(sampled.log_density, expected)
    by_step = of_demonstrator(state, demonstrations.transition)
    assert_close(demonstrations.log_density, summed(by_step, demonstrations.mask))


@pytest.mark.parametrize("append", [False, True])
def test_a_trajectorys_fused_density_is_of_one_policy_from_end_to_end(append):
    batches = take("fusion", "trajectory", append, draws=WHOLE_DRAWS)
    state = run("fusion", "trajectory")[0]
    for batch in batches:
        expected = mixed(summed(of_snapshots(batch.transition, STEPS), batch.mask))
        if append:
            by_step = of_demonstrator(state, batch.transition)
            expected = half_and_half(expected, summed(by_step, batch.mask))
        assert_close(batch.log_density, expected)


@pytest.mark.parametrize("weights", ["uniform", "recorded", "fusion"])
def test_before_an_episode_has_ended_nothing_is_there_to_count(weights):
    _, sampled = take(weights, "trajectory", draws=WHOLE_DRAWS, steps=2)
    assert not sampled.mask.any()
    assert np.isfinite(sampled.log_density).all()


def test_seeds_in_step_keep_their_own():
    record = jax.vmap(made("fusion", "trajectory").record, in_axes=(0, 0, None, 0, 0))
    actors = jax.tree.map(lambda *leaves: np.stack(leaves), actor_at(0), actor_at(1))
    state = made("fusion", "trajectory").init(KEY, ACTOR, POOL, SUBSET)
    states = jax.tree.map(lambda leaf: jnp.stack([leaf] * 2), state)
    inputs = actors, jnp.int32(PERIOD), jnp.zeros(2), jnp.array([True, False])
    states = jax.jit(record)(states, *inputs)
    snapshots = jax.tree.leaves(states.weights.snapshots)
    for leaf, actor in zip(snapshots, jax.tree.leaves(actors), strict=True):
        np.testing.assert_array_equal(leaf[:, 1], actor)
        assert not leaf[:, [0, 2]].any()
    np.testing.assert_array_equal(states.source.count, [1, 0])
    np.testing.assert_array_equal(states.source.length[:, 0], [PERIOD + 1, 0])


@pytest.mark.parametrize("name", ["snapshots", "snapshot_period", "episodes"])
def test_numbers_must_be_positive(name):
    settings = RewardBatchSettings(weights="fusion", **{name: 0})
    parts = SPEC, NETWORKS, BEHAVIOURS["epsilon-greedy"], REPLAY, CAPACITY
    with pytest.raises(ValueError, match="must be positive"):
        reward_batches.make(*parts, settings, objective="trajectory", append=True)
