"""What a step learns from the replay and the demonstrations: the inner lines of Algorithm 2."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import demonstrations, shaping
from cmedirl_jax.ddpg import DDPGInfo, DDPGState
from cmedirl_jax.demonstrations import DemonstrationSubset
from cmedirl_jax.irl import RewardState
from cmedirl_jax.methods import Algorithm, Method, Settings
from cmedirl_jax.replay import ReplayState
from cmedirl_jax.schedules import Plan
from cmedirl_jax.types import Transition


class Draws(NamedTuple):
    """The randomness of a step's minibatches.

    Attributes:
        batch: of the agent's, from the replay.
        background: of the reward's, from the replay; empty without a learned reward.
        demonstrations: rows of the pool; the reward and behaviour cloning read the same ones.
    """

    batch: jax.Array
    background: jax.Array
    demonstrations: jax.Array


class Updates(NamedTuple):
    """The updates of one step, as pure functions of one seed.

    Attributes:
        draw: `(key, subset) -> Draws`.
        stores_shaped: r* is stored in the replay in place of r_e (static).
        shape: `(reward_state, batch, plan) -> Transition` with r* in place of r_e (Eq. 10).
        update_reward: `(reward_state, pool, replay_state, draws) -> RewardState`, K iterations of
            Algorithm 1.
        update_agent: `(agent_state, reward_state, pool, replay_state, draws, plan) -> (DDPGState,
            DDPGInfo)`, one update on r*.
    """

    draw: Callable[[jax.Array, DemonstrationSubset | None], Draws]
    stores_shaped: bool
    shape: Callable[[RewardState | None, Transition, Plan], Transition]
    update_reward: Callable[[RewardState, Transition, ReplayState, Draws], RewardState]
    update_agent: Callable[..., tuple[DDPGState, DDPGInfo]]


def make(algorithm: Algorithm, method: Method, settings: Settings) -> Updates:
    """Make the updates of a method from its parts."""
    agent, learner, _, replay = algorithm
    schedule = settings.reward_schedule
    cloning = settings.schedule.cloning
    clones = method.hot_start and cloning != "none"
    stores_shaped = learner is not None and schedule.storage == "store"
    reward_batch = schedule.iterations * schedule.batch_size
    agent_batch = settings.schedule.batch_size
    # Constants, so that no branch is compiled: branches copy what passes through them.
    always_moves_targets = settings.schedule.target_period <= settings.schedule.update_period
    freezes_actor = method.hot_start and settings.schedule.frozen_actor_steps > 0

    def draw(key: jax.Array, subset: DemonstrationSubset | None) -> Draws:
        batch_key, background_key, demonstrations_key = jax.random.split(key, 3)
        nothing = jnp.zeros((0,), jnp.uint32)
        demonstrated = max(reward_batch, agent_batch) if clones else reward_batch
        return Draws(
            batch=replay.draw(batch_key, agent_batch),
            background=replay.draw(background_key, reward_batch) if learner else nothing,
            demonstrations=nothing
            if subset is None
            else demonstrations.sample_index(demonstrations_key, subset, demonstrated),
        )

    def shape(reward_state: RewardState | None, batch: Transition, plan: Plan) -> Transition:
        if learner is None or reward_state is None:
            return batch
        r_d = learner.reward(reward_state, batch.observation, batch.action)
        return batch._replace(reward=shaping.additive(batch.reward, r_d, plan.reward_weight))

    def update_reward(
        reward_state: RewardState, pool: Transition, replay_state: ReplayState, draws: Draws
    ) -> RewardState:
        assert learner is not None
        for k in range(schedule.iterations):
            rows = slice(k * schedule.batch_size, (k + 1) * schedule.batch_size)
            reward_state, _ = learner.update(
                reward_state,
                _rows(pool, draws.demonstrations[rows]),
                replay.take(replay_state, draws.background[rows], schedule.recent),
            )
        return reward_state

    def update_agent(
        agent_state: DDPGState,
        reward_state: RewardState | None,
        pool: Transition | None,
        replay_state: ReplayState,
        draws: Draws,
        plan: Plan,
    ) -> tuple[DDPGState, DDPGInfo]:
        batch = replay.take(replay_state, draws.batch)
        if not stores_shaped:
            batch = shape(reward_state, batch, plan)
        update_actor = plan.update_actor if freezes_actor else True
        update_targets = True if always_moves_targets else plan.update_targets
        if not clones:
            return agent.update(
                agent_state, batch, update_actor=update_actor, update_targets=update_targets
            )
        hparams = agent_state.hparams
        faded = hparams.replace(behaviour_cloning=hparams.behaviour_cloning * plan.cloning_weight)
        agent_state, info = agent.update(
            agent_state.replace(hparams=faded),
            batch,
            _rows(pool, draws.demonstrations[:agent_batch]),
            update_actor=update_actor,
            update_targets=update_targets,
            clone=True if cloning == "constant" else plan.cloning_weight > 0,
        )
        return agent_state.replace(hparams=hparams), info

    return Updates(draw, stores_shaped, shape, update_reward, update_agent)


def _rows(pool: Any, index: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], pool)
