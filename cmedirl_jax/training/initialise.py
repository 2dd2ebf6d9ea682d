"""How a seed begins: its demonstrations, its networks and their hot start, its reward."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import modes, observation_statistics
from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.ddpg import DDPGState
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.envs.base import Reset
from cmedirl_jax.irl import RewardState
from cmedirl_jax.irl.reward_batches import SamplerState
from cmedirl_jax.observation_statistics import Running
from cmedirl_jax.tabular import imitation, table_reward
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import Numeric, Params

Tree = TypeVar("Tree")

STATISTICS_SAMPLE = 4_096
"""Demonstrated steps that observations are normalised by, where their bounds do not do it."""


class TrainingState(flax.struct.PyTreeNode):
    """One seed.

    Attributes:
        key: of the seed's steps; never advanced, each step folds its number into it.
        agent: DDPG's state.
        reward: the learned reward's state, or None.
        storage: `[capacity, D]`, the replay's rows; its count is the number of steps taken.
        sampler: what is kept beside the replay for learning the reward, or None.
        exploration: the behaviour policy's state.
        env: the environment's state.
        observation: `[O]`, the current one.
        episode: `[]` int32, finished episodes.
        episode_return: `[]`, of the running episode.
        episode_length: `[]` int32, of the running episode.
        subset: the seed's own demonstrations, or None.
        observation_statistics: running statistics of the observations so far, which normalise them;
            None where their bounds do, or the demonstrations' statistics.
    """

    key: jax.Array
    agent: DDPGState
    reward: RewardState | None
    storage: jax.Array
    sampler: SamplerState | None
    exploration: Any
    env: Any
    observation: jax.Array
    episode: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    subset: DemonstrationSubset | None
    observation_statistics: Running | None = None


class Initialisation(NamedTuple):
    """Pure functions of one seed.

    Attributes:
        draw_networks: `key -> (actor, critic)`, the parameters that `init` starts from. They are
            the same for every method, so that one compiled program may draw them for all.
        hot_start: `(key, data, n_demonstrations, networks) -> networks`, the networks drawn after
            their hot start; as they are for a method without. Methods that share its settings share
            the result.
        init: `(key, data, n_demonstrations, networks=None, start=None) -> TrainingState`, the fit
            of a tabular reward included.
            `data` is what `hot_start.data` made of the pool, or None for methods without
            demonstrations; `networks` is what the two functions above gave, where they were called
            apart; `start` is the first state and observation of the task, by default those that its
            `reset` draws. A task on the host has no state here: `(None, observation)`.
    """

    draw_networks: Callable[[jax.Array], tuple[Params, Params]]
    hot_start: Callable[..., tuple[Params, Params]]
    init: Callable[..., TrainingState]


def make(
    env: Env | HostEnv,
    method: Method,
    settings: Settings,
    algorithm: Algorithm,
    *,
    env_params: Any,
    subset_size: int | None,
) -> Initialisation:
    """Make the initialisation of a method's seeds; see `trainer.make`."""
    parts = _Parts(env, env_params, method, settings, algorithm, subset_size)
    return Initialisation(
        functools.partial(_draw_networks, parts),
        functools.partial(_hot_start, parts),
        functools.partial(_init, parts),
    )


class _Parts(NamedTuple):
    """What the functions below are bound to."""

    env: Env | HostEnv
    env_params: Any
    method: Method
    settings: Settings
    algorithm: Algorithm
    subset_size: int | None


class SeedKeys(NamedTuple):
    """Independent keys for all that is drawn once per seed."""

    agent: jax.Array
    hot_start: jax.Array
    reward: jax.Array
    env: jax.Array
    noise: jax.Array
    subset: jax.Array
    sampler: jax.Array


def split(key: jax.Array) -> tuple[SeedKeys, jax.Array]:
    """The keys of the beginning, and the key that every step's number is folded into."""
    # `fold_in(key, i)` equals the i-th key of a split of `key`: the steps need a key of their own.
    setup_key, steps_key = jax.random.split(key)
    return SeedKeys(*jax.random.split(setup_key, len(SeedKeys._fields))), steps_key


def _draw_networks(parts: _Parts, key: jax.Array) -> tuple[Params, Params]:
    # A clone: `init` splits the same key.
    state = parts.algorithm.agent.init(split(jax.random.clone(key))[0].agent)
    return state.actor, state.critic


def _hot_start(
    parts: _Parts,
    key: jax.Array,
    data: HotStartData | None,
    n_demonstrations: Numeric,
    networks: tuple[Params, Params],
) -> tuple[Params, Params]:
    if not parts.method.hot_start:
        return networks
    keys, _ = split(jax.random.clone(key))
    data, subset = _demonstrations(parts, keys, data, n_demonstrations)
    networks = _with_statistics(keys, data, subset, networks)
    return hot_start.fit(
        keys.hot_start,
        parts.algorithm.agent.networks,
        networks,
        data,
        parts.settings.hot_start,
        subset=subset,
    )


def _demonstrations(
    parts: _Parts, keys: SeedKeys, data: HotStartData | None, n_demonstrations: Numeric
) -> tuple[HotStartData, DemonstrationSubset]:
    """The pool, and the seed's own demonstrations of it.

    Raises:
        ValueError: without a pool.
    """
    if data is None:
        raise ValueError(f"{parts.method.name} needs demonstrations")
    return data, demonstrations_lib.subset(
        keys.subset, data.episodes, n_demonstrations, parts.subset_size
    )


def _with_statistics(
    keys: SeedKeys, data: HotStartData, subset: DemonstrationSubset, params: Tree
) -> Tree:
    """Give networks that keep statistics those of a sample of the demonstrations."""
    if not observation_statistics.kept(params):
        return params
    rows = demonstrations_lib.sample_index(
        jax.random.fold_in(keys.subset, 0), subset, STATISTICS_SAMPLE
    )
    observations = jnp.asarray(data.transition.observation)[rows]
    return observation_statistics.put(params, observation_statistics.of_sample(observations))


def _init(
    parts: _Parts,
    key: jax.Array,
    data: HotStartData | None,
    n_demonstrations: Numeric,
    networks: tuple[Params, Params] | None = None,
    start: Reset | None = None,
) -> TrainingState:
    algorithm = parts.algorithm
    keys, steps_key = split(key)
    if networks is None:
        drawn = _draw_networks(parts, key)
        networks = _hot_start(parts, key, data, n_demonstrations, drawn)
    reward = algorithm.learner.init(keys.reward) if algorithm.learner else None
    subset, sampler_state = None, None

    # What the demonstrations give: a tabular reward, the sampler's fitted Gaussian.
    if parts.method.uses_demonstrations:
        data, subset = _demonstrations(parts, keys, data, n_demonstrations)
        networks = _with_statistics(keys, data, subset, networks)
        if reward is not None:
            params = _with_statistics(keys, data, subset, reward.params)
            reward = reward.replace(params=params)
        if parts.method.tabular is not None:
            reward = _fit_table(parts, keys, data, subset)
        if algorithm.sampler is not None:
            sampler_state = algorithm.sampler.init(
                keys.sampler, networks[0], data.transition, subset
            )

    # The first episode.
    env_state, observation = _first(parts, keys) if start is None else start
    running = None
    if observation_statistics.kept(networks) and not parts.method.uses_demonstrations:
        running = observation_statistics.begin(observation)
    state = TrainingState(
        key=steps_key,
        agent=algorithm.agent.init(keys.agent, networks),
        reward=reward,
        storage=algorithm.replay.init().storage,
        sampler=sampler_state,
        exploration=algorithm.exploration.init(keys.noise),
        env=env_state,
        observation=observation,
        episode=jnp.zeros((), jnp.int32),
        episode_return=jnp.zeros((), jnp.float32),
        episode_length=jnp.zeros((), jnp.int32),
        subset=subset,
        observation_statistics=running,
    )
    return modes.vary(state, key)


def _first(parts: _Parts, keys: SeedKeys) -> Reset:
    if isinstance(parts.env, HostEnv):
        raise ValueError(f"{parts.env.spec.id} is stepped on the host: give init a start")
    return parts.env.reset(keys.env, parts.env_params)


def _fit_table(
    parts: _Parts, keys: SeedKeys, data: HotStartData, subset: DemonstrationSubset
) -> RewardState:
    """The reward that dynamic programming learns from the demonstrations."""
    assert parts.method.tabular is not None
    assert isinstance(parts.env, Env)
    settings = parts.settings
    mdp = imitation.discretised(parts.env, settings.tabular, params=parts.env_params)
    fitted = imitation.fit(
        keys.reward,
        mdp,
        parts.env.spec,
        data,
        subset,
        kind=parts.method.tabular,
        settings=settings.tabular,
    )
    visits = imitation.visitation(mdp, data, subset, discount=settings.tabular.discount).visitation
    return table_reward.state(
        fitted.reward[:-1],
        jnp.sum(visits[:-1], axis=1),
        settings.tabular.deviation,
        settings.reward,
    )
