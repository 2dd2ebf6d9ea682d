"""One environment step of Algorithm 2 in phases: act, learn the reward, learn the agent, log.

The functions that need the method's parts take `StepParts` first; `trainer` binds them.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import modes, observation_statistics
from cmedirl_jax.agents.ddpg import DDPGState
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.replay import ReplayState
from cmedirl_jax.envs import Step
from cmedirl_jax.irl import RewardInfo, RewardState, base
from cmedirl_jax.irl.reward_batches import SamplerState
from cmedirl_jax.training import updates
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.schedules import Plan
from cmedirl_jax.training.updates import Added, UpdateDraws, UpdateParts
from cmedirl_jax.types import Numeric, Transition


class Log(NamedTuple):
    """What each of `T` steps did, leaves `[T]`.

    Attributes:
        done: an episode ended at this step (and the seed was still running).
        terminated: the task itself ended the episode at this step: a goal, or a fall.
        episode_return: undiscounted return of the episode so far, the environment's reward alone.
        episode_length: steps of the episode so far.
        learned: actor and critic were updated at this step.
        critic_loss: of that update, else 0.
        q_mean: of that update, else 0.
        added: what r_D adds to r_e over that update's minibatch, or over this step's transition
            where r* is stored, else zeros; None for methods without r_D.
        reward_learned: the reward was updated at this step.
        reward: diagnostics of that update, else zeros; None for methods that learn no reward.
    """

    done: jax.Array
    terminated: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    learned: jax.Array
    critic_loss: jax.Array
    q_mean: jax.Array
    added: Added | None
    reward_learned: jax.Array
    reward: RewardInfo | None


class StepDraws(NamedTuple):
    """The randomness of a step, apart from the task's own.

    Attributes:
        noise: of the behaviour policy.
        updates: of the minibatches.
    """

    noise: Any
    updates: UpdateDraws


class Behaviour(NamedTuple):
    """What the behaviour policy does in a state.

    Attributes:
        action: `[A]`.
        log_density: `[]`, log b(a|s), given the noise's state.
        exploration: the noise's state afterwards.
    """

    action: jax.Array
    log_density: jax.Array
    exploration: Any


class StepParts(NamedTuple):
    """What a method's steps are made of. All static.

    Attributes:
        algorithm: the method's parts.
        updates: what its updates are made of.
        max_episode_steps: steps after which an episode ends, whatever the task says.
    """

    algorithm: Algorithm
    updates: UpdateParts
    max_episode_steps: int


def step_keys(key: jax.Array, step: jax.Array) -> jax.Array:
    """Keys `[4]` of a step: the environment, the next start, the noise, the minibatches."""
    return jax.random.split(jax.random.fold_in(key, step), 4)


def draw(
    parts: StepParts,
    key: jax.Array,
    subset: DemonstrationSubset | None,
    step: jax.Array,
    demonstrated: Numeric = True,
) -> StepDraws:
    """Draw the randomness of step number `step` `[]`; see `trainer.Trainer`."""
    _, _, noise_key, updates_key = step_keys(key, step)
    return StepDraws(
        noise=parts.algorithm.exploration.draw(noise_key),
        updates=updates.draw(parts.updates, updates_key, subset, demonstrated),
    )


def behave(parts: StepParts, state: TrainingState, draws: StepDraws, plan: Plan) -> Behaviour:
    """Act: the first half of a step; see `trainer.Trainer`."""
    greedy = parts.algorithm.agent.act(state.agent, state.observation)
    return Behaviour(
        *parts.algorithm.exploration.perturb(state.exploration, greedy, draws.noise, plan.step)
    )


def learn(
    parts: StepParts,
    state: TrainingState,
    behaviour: Behaviour,
    answer: Step,
    next_start: jax.Array,
    draws: StepDraws,
    plan: Plan,
    pool: Transition | None,
    max_episodes: Numeric | None = None,
) -> tuple[TrainingState, Log]:
    """Do all that follows from the task's answer; see `trainer.Trainer`."""
    # Store the transition.
    ended = has_ended(parts, state, answer)
    transition = Transition(
        state.observation, behaviour.action, answer.reward, answer.observation, answer.terminated
    )
    replay_state = parts.algorithm.replay.add(ReplayState(state.storage, plan.step), transition)

    # Learn the reward.
    reward, sampler, reward_info = _learn_reward(
        parts, state, behaviour, ended, replay_state, draws, plan, pool
    )
    stored = None
    if parts.updates.stores_shaped:
        replay_state, stored = _store_shaped(parts, state, reward, transition, replay_state, plan)

    # Learn the agent.
    agent, losses = _learn_agent(parts, state.agent, reward, replay_state, draws, plan, pool)
    agent, reward, statistics = _move_statistics(state, answer, next_start, ended, agent, reward)
    losses = losses._replace(added=losses.added or stored)
    done = ended
    if max_episodes is not None:
        running = state.episode < max_episodes
        done = ended & running
        agent, reward = _keep_parameters(running, state, agent, reward)

    # Log, and go on.
    log = _log(state, answer, done, plan, losses, reward_info)
    state = state.replace(
        agent=agent,
        reward=reward,
        storage=replay_state.storage,
        sampler=sampler,
        observation_statistics=statistics,
    )
    return _next_episode(parts, state, behaviour, answer, next_start, ended, log), log


def has_ended(parts: StepParts, state: TrainingState, answer: Step) -> jax.Array:
    """Whether the episode ends with this answer, by the task or by the specification's limit."""
    at_limit = state.episode_length + 1 >= parts.max_episode_steps
    return answer.terminated | answer.truncated | at_limit


def _learn_reward(
    parts: StepParts,
    state: TrainingState,
    behaviour: Behaviour,
    ended: jax.Array,
    replay_state: ReplayState,
    draws: StepDraws,
    plan: Plan,
    pool: Transition | None,
) -> tuple[RewardState | None, SamplerState | None, RewardInfo | None]:
    """Record what the samples need, and learn the reward where the plan says so."""
    sampler = parts.algorithm.sampler
    if sampler is None or state.sampler is None:
        return state.reward, state.sampler, None
    sampler_state = sampler.record(
        state.sampler, state.agent.actor, plan.step, behaviour.log_density, ended
    )
    take = functools.partial(
        sampler.take, sampler_state, pool, state.subset, replay_state, behaviour.exploration
    )
    reward, info = jax.lax.cond(
        plan.learn_reward,
        lambda reward: modes.vary(
            updates.update_reward(parts.updates, reward, take, draws.updates), state, pool
        ),
        lambda reward: modes.vary((reward, base.no_info()), state, pool),
        state.reward,
    )
    return reward, sampler_state, info


def _store_shaped(
    parts: StepParts,
    state: TrainingState,
    reward: RewardState | None,
    transition: Transition,
    replay_state: ReplayState,
    plan: Plan,
) -> tuple[ReplayState, Added]:
    """Write r* over the r_e that was just stored; Algorithm 2 learns the reward first."""
    discount = state.agent.hparams.discount
    shaped = updates.with_shaped_reward(
        parts.updates, reward, transition, discount, plan.reward_weight
    )
    replay_state = parts.algorithm.replay.add(ReplayState(replay_state.storage, plan.step), shaped)
    return replay_state, updates.added(parts.updates, transition, shaped)


class _Losses(NamedTuple):
    """Diagnostics of one update of the agent, as `Log` has them."""

    critic_loss: jax.Array
    q_mean: jax.Array
    added: Added | None


def _learn_agent(
    parts: StepParts,
    agent: DDPGState,
    reward: RewardState | None,
    replay_state: ReplayState,
    draws: StepDraws,
    plan: Plan,
    pool: Transition | None,
) -> tuple[DDPGState, _Losses]:
    """Learn actor and critic where the plan says so; also the update's losses, else zeros."""

    def update(agent: DDPGState) -> tuple[DDPGState, _Losses]:
        agent, info, added = updates.update_agent(
            parts.updates, agent, reward, pool, replay_state, draws.updates, plan
        )
        return agent, _Losses(info.critic_loss, info.q_mean, added)

    zero = modes.vary(jnp.zeros((), jnp.float32), agent, reward, replay_state, pool)
    here = reward is not None and not parts.updates.stores_shaped
    none = _Losses(zero, zero, Added(zero, zero) if here else None)
    return jax.lax.cond(plan.learn, update, lambda agent: (agent, none), agent)


def _move_statistics(
    state: TrainingState,
    answer: Step,
    next_start: jax.Array,
    ended: jax.Array,
    agent: DDPGState,
    reward: RewardState | None,
) -> tuple[DDPGState, RewardState | None, observation_statistics.Running | None]:
    """Add the new observations to the running statistics, and give them to every network.

    A random reward normalises by them too, though its weights never change.
    """
    running = state.observation_statistics
    if running is None:
        return agent, reward, None
    running = observation_statistics.add(running, answer.observation)
    running = select(ended, observation_statistics.add(running, next_start), running)
    statistics = observation_statistics.of_running(running)
    agent = agent.replace(
        **{
            name: observation_statistics.put(getattr(agent, name), statistics)
            for name in ("actor", "critic", "target_actor", "target_critic")
        }
    )
    if reward is not None:
        reward = reward.replace(params=observation_statistics.put(reward.params, statistics))
    return agent, reward, running


def _keep_parameters(
    running: jax.Array, before: TrainingState, agent: DDPGState, reward: RewardState | None
) -> tuple[DDPGState, RewardState | None]:
    """Keep a stopped seed's parameters, which are read later; its other state may move."""
    agent = agent.replace(
        actor=select(running, agent.actor, before.agent.actor),
        critic=select(running, agent.critic, before.agent.critic),
    )
    if reward is not None and before.reward is not None:
        reward = reward.replace(params=select(running, reward.params, before.reward.params))
    return agent, reward


def _log(
    state: TrainingState,
    answer: Step,
    done: jax.Array,
    plan: Plan,
    losses: _Losses,
    reward: RewardInfo | None,
) -> Log:
    return Log(
        done=done,
        terminated=answer.terminated,
        episode_return=state.episode_return + answer.reward,
        episode_length=state.episode_length + 1,
        learned=plan.learn,
        critic_loss=losses.critic_loss,
        q_mean=losses.q_mean,
        added=losses.added,
        reward_learned=plan.learn_reward,
        reward=reward,
    )


def _next_episode(
    parts: StepParts,
    state: TrainingState,
    behaviour: Behaviour,
    answer: Step,
    next_start: jax.Array,
    ended: jax.Array,
    log: Log,
) -> TrainingState:
    """Go on to the next observation, which begins another episode where this one has ended."""
    reset = parts.algorithm.exploration.reset(behaviour.exploration)
    return state.replace(
        exploration=select(ended, reset, behaviour.exploration),
        observation=select(ended, next_start, answer.observation),
        episode=state.episode + log.done,
        episode_return=jnp.where(ended, 0.0, log.episode_return),
        episode_length=jnp.where(ended, 0, log.episode_length),
    )


def select(predicate: jax.Array, on_true: Any, on_false: Any) -> Any:
    """`jnp.where` by a scalar `predicate`, for pytrees."""
    return jax.tree.map(lambda x, y: jnp.where(predicate, x, y), on_true, on_false)
