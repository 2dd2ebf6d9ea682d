"""A replay that a changing policy has filled, a pool, and the samples drawn from both."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import networks
from cmedirl_jax.agents import exploration
from cmedirl_jax.agents.exploration import EpsilonGreedyHParams, OrnsteinUhlenbeckHParams
from cmedirl_jax.data import replay
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.replay import ReplayState
from cmedirl_jax.irl import reward_batches
from cmedirl_jax.irl.reward_batches import RewardBatchSettings, SampleDraws
from cmedirl_jax.networks import Architecture
from cmedirl_jax.types import Transition
from tests.support.agents import SPEC as ENV_SPEC

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


def assert_equal(actual, expected):
    chex.assert_trees_all_equal(actual, expected)


def numbers(batch):
    """The transitions of each trajectory, in order."""
    rewards = np.int32(batch.transition.reward)
    return [tuple(row[mask]) for row, mask in zip(rewards, np.asarray(batch.mask), strict=True)]
