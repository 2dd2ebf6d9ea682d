"""What a step learns from the replay and the demonstrations: the inner lines of Algorithm 2."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax.agents.ddpg import DDPGInfo, DDPGState
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.replay import ReplayState
from cmedirl_jax.irl import RewardInfo, RewardState, base, regularisers, shaping
from cmedirl_jax.irl.reward_batches import SampleDraws
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.methods import Method, Settings
from cmedirl_jax.training.schedules import Plan
from cmedirl_jax.types import Numeric, Transition


class Draws(NamedTuple):
    """The randomness of a step's minibatches; what a method does not use is empty.

    Attributes:
        batch: of the agent's, from the replay.
        reward: of the reward's, K iterations one after the other.
        penalty: key of the reward's other randomness, or None.
        cloning: rows of the pool for behaviour cloning; of pairs, the reward reads the same ones.
    """

    batch: jax.Array
    reward: SampleDraws
    penalty: jax.Array | None
    cloning: jax.Array


class Updates(NamedTuple):
    """The updates of one step, as pure functions of one seed.

    Attributes:
        draw: `(key, subset) -> Draws`.
        stores_shaped: r* is stored in the replay in place of r_e (static).
        shape: `(reward_state, batch, discount, weight) -> Transition` with r* in place of r_e (Eq.
            10).
        update_reward: `(reward_state, samples, draws) -> (RewardState, RewardInfo)`, K iterations
            of Algorithm 1 and the last one's diagnostics; `samples` takes `SampleDraws`.
        update_agent: `(agent_state, reward_state, pool, replay_state, draws, plan) -> (DDPGState,
            DDPGInfo)`, one update on r*.
    """

    draw: Callable[[jax.Array, DemonstrationSubset | None], Draws]
    stores_shaped: bool
    shape: Callable[..., Transition]
    update_reward: Callable[..., tuple[RewardState, RewardInfo]]
    update_agent: Callable[..., tuple[DDPGState, DDPGInfo]]


def make(algorithm: Algorithm, method: Method, settings: Settings) -> Updates:
    """Make the updates of a method from its parts."""
    agent, learner, replay = algorithm.agent, algorithm.learner, algorithm.replay
    sampler = algorithm.sampler
    schedule = settings.reward_schedule
    cloning = settings.schedule.cloning
    clones = method.hot_start and cloning != "none"
    stores_shaped = learner is not None and schedule.storage == "store"
    maxent = method.reward == "maxent"
    penalised = maxent and settings.reward.gradient_penalty is not None
    per_iteration = 0 if sampler is None else sampler.batch_size
    sampled = schedule.iterations * per_iteration
    shared = sampled if sampler is not None and sampler.shares_pairs else 0
    agent_batch = settings.schedule.batch_size
    # Constants, so that no branch is compiled: branches copy what passes through them.
    always_moves_targets = settings.schedule.target_period <= settings.schedule.update_period
    freezes_actor = method.hot_start and settings.schedule.frozen_actor_steps > 0

    def draw(key: jax.Array, subset: DemonstrationSubset | None) -> Draws:
        batch_key, background_key, demonstrations_key = jax.random.split(key, 3)
        rows = jnp.zeros((0,), jnp.int32)
        pairs = max(agent_batch if clones else 0, shared)
        if pairs and subset is not None:
            rows = demonstrations.sample_index(demonstrations_key, subset, pairs)
        chosen = rows[:sampled]
        if sampler is not None and subset is not None:
            chosen = sampler.choose(jax.random.fold_in(key, 4), subset, rows, sampled)
        return Draws(
            batch=replay.draw(batch_key, agent_batch),
            reward=SampleDraws(replay.draw(background_key, sampled), chosen),
            penalty=jax.random.fold_in(key, 3) if penalised else None,
            cloning=rows[:agent_batch] if clones else rows[:0],
        )

    def shape(
        reward_state: RewardState | None, batch: Transition, discount: Numeric, weight: Numeric
    ) -> Transition:
        if learner is None or reward_state is None:
            return batch
        r_d = learner.reward(reward_state, batch.observation, batch.action)
        if algorithm.shaping == "potential":
            after = learner.reward(reward_state, batch.next_observation, batch.action)
            reward = shaping.potential(batch.reward, r_d, after, batch.terminated, discount, weight)
            return batch._replace(reward=reward)
        if learner.absorbing is not None:
            r_d += regularisers.absorbed_reward(
                learner.absorbing(reward_state), batch.terminated, discount
            )
        r_e = batch.reward if algorithm.shaping == "additive" else jnp.zeros_like(batch.reward)
        return batch._replace(reward=shaping.additive(r_e, r_d, weight))

    def update_reward(
        reward_state: RewardState,
        samples: Callable[[SampleDraws], tuple[Any, Any]],
        draws: Draws,
    ) -> tuple[RewardState, RewardInfo]:
        assert learner is not None
        info = base.no_info()
        for k in range(schedule.iterations):
            rows = slice(k * per_iteration, (k + 1) * per_iteration)
            key = None if draws.penalty is None else jax.random.fold_in(draws.penalty, k)
            batches = samples(jax.tree.map(lambda leaf, rows=rows: leaf[rows], draws.reward))
            reward_state, info = learner.update(reward_state, *batches, key=key)
        return reward_state, info

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
            discount = agent_state.hparams.discount
            batch = shape(reward_state, batch, discount, plan.reward_weight)
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
            demonstrations.at(pool, draws.cloning),  # type: ignore[arg-type]
            update_actor=update_actor,
            update_targets=update_targets,
            clone=True if cloning == "constant" else plan.cloning_weight > 0,
        )
        return agent_state.replace(hparams=hparams), info

    return Updates(draw, stores_shaped, shape, update_reward, update_agent)
