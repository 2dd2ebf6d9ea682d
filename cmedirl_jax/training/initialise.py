"""How a seed begins: its demonstrations, its networks and their hot start, its reward."""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.ddpg import DDPGState
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.envs import Env
from cmedirl_jax.irl import RewardState
from cmedirl_jax.irl.reward_batches import SamplerState
from cmedirl_jax.tabular import imitation, table_reward
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.methods import Method, Settings
from cmedirl_jax.types import Numeric, Params


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


class Initialisation(NamedTuple):
    """Pure functions of one seed.

    Attributes:
        draw_networks: `key -> (actor, critic)`, the parameters that `init` starts from. They are
            the same for every method, so that one compiled program may draw them for all.
        init: `(key, data, n_demonstrations, networks=None) -> TrainingState`, the hot start and the
            fit of a tabular reward included.
            `data` is what `hot_start.data` made of the pool, or None for methods without
            demonstrations; `networks` is what `draw_networks` gave, where that was called apart.
    """

    draw_networks: Callable[[jax.Array], tuple[Params, Params]]
    init: Callable[..., TrainingState]


def make(
    env: Env,
    method: Method,
    settings: Settings,
    algorithm: Algorithm,
    *,
    env_params: Any,
    subset_size: int | None,
) -> Initialisation:
    """Make the initialisation of a method's seeds; see `step.make`."""
    agent, learner, sampler = algorithm.agent, algorithm.learner, algorithm.sampler

    def split(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        # Apart from the steps' keys: folding i into a key gives the i-th key of its split.
        setup_key, steps_key = jax.random.split(key)
        return jax.random.split(setup_key, 7), steps_key

    def draw_networks(key: jax.Array) -> tuple[Params, Params]:
        (agent_key, *_), _ = split(key)
        state = agent.init(agent_key)
        return state.actor, state.critic

    def fit_tabular(
        key: jax.Array, data: HotStartData, subset: DemonstrationSubset, kind: imitation.Kind
    ) -> RewardState:
        mdp = imitation.discretised(env, settings.tabular, params=env_params)
        found = imitation.fit(
            key, mdp, env.spec, data, subset, kind=kind, settings=settings.tabular
        )
        return table_reward.state(found.reward[:-1], settings.reward)

    def init(
        key: jax.Array,
        data: HotStartData | None,
        n_demonstrations: Numeric,
        networks: tuple[Params, Params] | None = None,
    ) -> TrainingState:
        keys, steps_key = split(key)
        agent_key, fit_key, reward_key, env_key, noise_key, subset_key, sampler_key = keys
        if networks is None:
            networks = draw_networks(key)
        subset = None
        reward = learner.init(reward_key) if learner else None
        sampler_state = None
        if method.uses_demonstrations:
            if data is None:
                raise ValueError(f"{method.name} needs demonstrations")
            subset = demonstrations_lib.subset(
                subset_key, data.episodes, n_demonstrations, subset_size
            )
            if method.hot_start:
                networks = hot_start.fit(
                    fit_key, agent.networks, networks, data, settings.hot_start, subset=subset
                )
            if method.tabular is not None:
                reward = fit_tabular(reward_key, data, subset, method.tabular)
            if sampler is not None:
                sampler_state = sampler.init(sampler_key, networks[0], data.transition, subset)
        env_state, observation = env.reset(env_key, env_params)
        return TrainingState(
            key=steps_key,
            agent=agent.init(agent_key, networks),
            reward=reward,
            storage=algorithm.replay.init().storage,
            sampler=sampler_state,
            exploration=algorithm.exploration.init(noise_key),
            env=env_state,
            observation=observation,
            episode=jnp.zeros((), jnp.int32),
            episode_return=jnp.zeros(()),
            episode_length=jnp.zeros((), jnp.int32),
            subset=subset,
        )

    return Initialisation(draw_networks, init)
