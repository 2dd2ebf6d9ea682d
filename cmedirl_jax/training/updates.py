"""What a step learns from the replay and the demonstrations: the inner lines of Algorithm 2.

The functions that need the method's parts take `UpdateParts` first.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import modes
from cmedirl_jax.agents.ddpg import DDPGInfo, DDPGState
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.replay import ReplayState
from cmedirl_jax.irl import RewardInfo, RewardState, base, regularisers, shaping
from cmedirl_jax.irl.reward_batches import SampleDraws
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.schedules import Cloning, Plan
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import Numeric, RewardBatch, Transition


class UpdateParts(NamedTuple):
    """What a method's updates are made of. All static.

    Attributes:
        algorithm: the method's parts.
        batch_size: transitions per update of the agent.
        recent: latest transitions that they are drawn from; None: all of the replay.
        iterations: K of Algorithm 1, iterations per update of the reward.
        cloning: how the behaviour-cloning term goes on after the hot start.
        stores_shaped: r* is stored in the replay in place of r_e.
        freezes_actor: a hot-started actor waits while the critic learns.
        always_moves_targets: the targets move at every update of the agent.
    """

    algorithm: Algorithm
    batch_size: int
    recent: int | None
    iterations: int
    cloning: Cloning
    stores_shaped: bool
    freezes_actor: bool
    always_moves_targets: bool

    @property
    def reward_samples(self) -> int:
        """Samples of each kind that the K iterations of a reward's update read in all."""
        sampler = self.algorithm.sampler
        return 0 if sampler is None else self.iterations * sampler.batch_size


def make_parts(algorithm: Algorithm, method: Method, settings: Settings) -> UpdateParts:
    """Read off the settings what is static, so that no branch is compiled for it."""
    schedule, reward_schedule = settings.schedule, settings.reward_schedule
    return UpdateParts(
        algorithm=algorithm,
        batch_size=schedule.batch_size,
        recent=schedule.recent,
        iterations=reward_schedule.iterations,
        cloning=schedule.cloning if method.hot_start else "none",
        stores_shaped=algorithm.learner is not None and reward_schedule.storage == "store",
        freezes_actor=method.hot_start and schedule.frozen_actor_steps > 0,
        always_moves_targets=schedule.target_period <= schedule.update_period,
    )


class Added(NamedTuple):
    """What r_D adds to the reward r_e over a minibatch, or over one transition.

    Attributes:
        mean: `[]`.
        mean_square: `[]`.
    """

    mean: jax.Array
    mean_square: jax.Array


class UpdateDraws(NamedTuple):
    """The randomness of a step's minibatches; what a method does not use is empty.

    Attributes:
        batch: of the agent's minibatch, from the replay.
        reward: of the reward's samples, K iterations one after the other.
        penalty: key of the reward's other randomness, or None.
        cloning: rows of the pool for behaviour cloning. Where the reward learns from pairs, it
            reads the same rows.
    """

    batch: jax.Array
    reward: SampleDraws
    penalty: jax.Array | None
    cloning: jax.Array


def draw(
    parts: UpdateParts,
    key: jax.Array,
    subset: DemonstrationSubset | None,
    demonstrated: Numeric = True,
) -> UpdateDraws:
    """Draw a step's minibatches from the seed's subset of the demonstrations.

    Where `demonstrated` is False nothing is learned from demonstrations: zeros stand for what would
    be drawn for that.
    """
    replay, sampler = parts.algorithm.replay, parts.algorithm.sampler
    # Key i of a split is `fold_in(key, i)`: what is folded in below begins at 3.
    batch_key, background_key, demonstrations_key = jax.random.split(key, 3)
    # Rows of the pool, shared by behaviour cloning and a reward that learns from pairs.
    cloned = 0 if parts.cloning == "none" else parts.batch_size
    sampled = parts.reward_samples
    shared = sampled if sampler is not None and sampler.shares_pairs else 0

    def draw_demonstrated() -> tuple[SampleDraws, jax.Array]:
        rows = jnp.zeros((0,), jnp.int32)
        if max(cloned, shared) and subset is not None:
            rows = demonstrations.sample_index(demonstrations_key, subset, max(cloned, shared))
        chosen = rows[:0]
        if sampler is not None and subset is not None:
            chosen = sampler.choose(jax.random.fold_in(key, 4), subset, rows, sampled)
        drawn = SampleDraws(replay.draw(background_key, sampled), chosen), rows[:cloned]
        return modes.vary(drawn, key, subset)

    shapes = jax.eval_shape(draw_demonstrated)
    zeros = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shapes)
    reward, cloning = jax.lax.cond(
        demonstrated, draw_demonstrated, lambda: modes.vary(zeros, key, subset)
    )
    return UpdateDraws(
        batch=replay.draw(batch_key, parts.batch_size),
        reward=reward,
        penalty=jax.random.fold_in(key, 3) if parts.algorithm.reward_draws else None,
        cloning=cloning,
    )


def with_shaped_reward(
    parts: UpdateParts,
    reward_state: RewardState | None,
    batch: Transition,
    discount: Numeric,
    weight: Numeric,
) -> Transition:
    """Put r* in place of r_e (Eq. 10).

    Args:
        parts: the method's.
        reward_state: the state of r_D; None for a method without.
        batch: transitions `[..., ...]` with the environment's reward r_e.
        discount: the agent's.
        weight: of r_D beside r_e.
    """
    learner, how = parts.algorithm.learner, parts.algorithm.shaping
    if learner is None or reward_state is None:
        return batch
    r_d = learner.reward(reward_state, batch.observation, batch.action)
    if how == "potential":
        after = learner.reward(reward_state, batch.next_observation, batch.action)
        reward = shaping.potential(batch.reward, r_d, after, batch.terminated, discount, weight)
        return batch._replace(reward=reward)
    if learner.absorbing is not None:
        r_d += regularisers.absorbed_reward(
            learner.absorbing(reward_state), batch.terminated, discount
        )
    r_e = batch.reward if how == "additive" else jnp.zeros_like(batch.reward)
    return batch._replace(reward=shaping.additive(r_e, r_d, weight))


def added(parts: UpdateParts, batch: Transition, shaped: Transition) -> Added:
    """What shaping added to a batch; all of r* for a method that learns from r_D alone."""
    difference = shaped.reward
    if parts.algorithm.shaping != "alone":
        difference = shaped.reward - batch.reward
    return Added(jnp.mean(difference), jnp.mean(jnp.square(difference)))


def update_reward(
    parts: UpdateParts,
    reward_state: RewardState,
    take: Callable[[SampleDraws], tuple[RewardBatch, RewardBatch]],
    draws: UpdateDraws,
) -> tuple[RewardState, RewardInfo]:
    """K iterations of Algorithm 1; the diagnostics are the last one's.

    Args:
        parts: of a method that learns its reward.
        reward_state: the state before.
        take: turns an iteration's draws into its demonstrations and background.
        draws: the step's.
    """
    learner, sampler = parts.algorithm.learner, parts.algorithm.sampler
    assert learner is not None
    assert sampler is not None
    info = base.no_info()
    for k in range(parts.iterations):
        rows = slice(k * sampler.batch_size, (k + 1) * sampler.batch_size)
        key = None if draws.penalty is None else jax.random.fold_in(draws.penalty, k)
        batches = take(jax.tree.map(lambda leaf, rows=rows: leaf[rows], draws.reward))
        reward_state, info = learner.update(reward_state, *batches, key=key)
    return reward_state, info


def update_agent(
    parts: UpdateParts,
    agent_state: DDPGState,
    reward_state: RewardState | None,
    pool: Transition | None,
    replay_state: ReplayState,
    draws: UpdateDraws,
    plan: Plan,
) -> tuple[DDPGState, DDPGInfo, Added | None]:
    """One update of actor and critic on r*; also what r_D added, where that is not stored.

    Args:
        parts: the method's.
        agent_state: the state before.
        reward_state: the state of r_D; None for a method without.
        pool: the demonstrations' transitions `[N, ...]`; None for a method without.
        replay_state: where the minibatch comes from.
        draws: the step's.
        plan: what the step does.
    """
    agent, hparams = parts.algorithm.agent, agent_state.hparams
    # The minibatch, with r* in place of r_e.
    batch, by_reward = parts.algorithm.replay.take(replay_state, draws.batch, parts.recent), None
    if reward_state is not None and not parts.stores_shaped:
        shaped = with_shaped_reward(
            parts, reward_state, batch, hparams.discount, plan.reward_weight
        )
        batch, by_reward = shaped, added(parts, batch, shaped)
    update_actor = plan.update_actor if parts.freezes_actor else True
    update_targets = True if parts.always_moves_targets else plan.update_targets
    if parts.cloning == "none":
        agent_state, info = agent.update(
            agent_state, batch, update_actor=update_actor, update_targets=update_targets
        )
        return agent_state, info, by_reward
    # The cloning term fades by its weight; the state keeps the weight that it began with.
    assert pool is not None
    faded = hparams.replace(behaviour_cloning=hparams.behaviour_cloning * plan.cloning_weight)
    agent_state, info = agent.update(
        agent_state.replace(hparams=faded),
        batch,
        demonstrations.at(pool, draws.cloning),
        update_actor=update_actor,
        update_targets=update_targets,
        clone=True if parts.cloning == "constant" else plan.cloning_weight > 0,
    )
    return agent_state.replace(hparams=hparams), info, by_reward
