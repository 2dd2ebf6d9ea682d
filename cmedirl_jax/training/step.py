"""Algorithm 2 for one seed, as functions that vmap over seeds.

    trainer = training.make(env, METHODS["hs-me-ddpg"], Settings(), capacity=12_000)
    states = jax.vmap(trainer.init, in_axes=(0, None, None))(keys, data, 200)
    states, log = jax.jit(jax.vmap(trainer.run, in_axes=(0, None, None)))(states, data, steps)

Every step's randomness is drawn from `fold_in(seed's key, step)`, so that what a seed does depends
neither on how many seeds run beside it nor on how its steps are cut into chunks.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import envs
from cmedirl_jax import networks as networks_lib
from cmedirl_jax.agents.ddpg import DDPGState
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.replay import ReplayState
from cmedirl_jax.envs import Env
from cmedirl_jax.irl import RewardInfo, RewardState, base
from cmedirl_jax.training import compose, initialise, schedules, updates
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.methods import Method, Settings
from cmedirl_jax.training.schedules import Plan
from cmedirl_jax.training.updates import Draws
from cmedirl_jax.types import Numeric, Params, Transition


class Log(NamedTuple):
    """What each of `T` steps did, leaves `[T]`.

    Attributes:
        done: an episode ended at this step (and the seed was still running).
        terminated: it ended at the goal rather than by the time limit.
        episode_return: undiscounted return of the episode so far, the environment's reward alone.
        episode_length: steps of the episode so far.
        learned: actor and critic were updated at this step.
        critic_loss: of that update, else 0.
        q_mean: of that update, else 0.
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
    reward_learned: jax.Array
    reward: RewardInfo | None


class Trainer(NamedTuple):
    """A method on an environment as pure functions of one seed.

    Attributes:
        algorithm: the method's parts.
        draw_networks: see `initialisation.Initialisation`.
        init: likewise.
        run: `(state, data, steps, max_episodes=None) -> (TrainingState, Log)` for `steps` `[T]`
            int32, the numbers t, t + 1, ... of the environment steps to take. Under vmap leave
            `data`, `steps` and `max_episodes` unbatched: branches are taken by them. A seed that
            has finished `max_episodes` episodes learns no more.
        act: `(actor parameters, observation [..., O]) -> action [..., A]`, mu(s).
    """

    algorithm: Algorithm
    draw_networks: Callable[[jax.Array], tuple[Params, Params]]
    init: Callable[..., TrainingState]
    run: Callable[..., tuple[TrainingState, Log]]
    act: Callable[..., jax.Array]


class _Draws(NamedTuple):
    """All randomness of a step; `reset` is the start of the next episode, should this one end."""

    env: jax.Array
    reset: tuple[Any, jax.Array]
    noise: Any
    updates: Draws


def make(
    env: Env,
    method: Method,
    settings: Settings | None = None,
    *,
    capacity: int,
    env_params: Any = None,
    subset_size: int | None = None,
) -> Trainer:
    """Make a trainer.

    Args:
        env: the environment.
        method: one of `METHODS`, or your own.
        settings: every other choice.
        capacity: transitions in the replay where `settings.schedule` leaves it open.
        env_params: default `env.default_params`.
        subset_size: pad each seed's subset to this many demonstrations, so that their number may be
            traced: one program for every number of demonstrations.

    Raises:
        ValueError: for a method without networks (`tabular.imitation` fits those), an environment
            that does not keep to its specification, numbers out of their range, or settings that do
            not fit each other.
        TypeError: for an environment of other dtypes.
    """
    if method.tabular and not method.interacts:
        raise ValueError(f"{method.name} does not act: there is nothing to train")
    settings = settings or Settings()
    env_params = env.default_params if env_params is None else env_params
    envs.check(env, env_params)
    algorithm = compose.compose(env.spec, method, settings, capacity)
    agent, exploration, replay = algorithm.agent, algorithm.exploration, algorithm.replay
    sampler = algorithm.sampler
    update = updates.make(algorithm, method, settings)
    beginning = initialise.make(
        env, method, settings, algorithm, env_params=env_params, subset_size=subset_size
    )

    def draw(key: jax.Array, subset: DemonstrationSubset | None, step: jax.Array) -> _Draws:
        keys = jax.random.split(jax.random.fold_in(key, step), 4)
        return _Draws(
            env=keys[0],
            reset=env.reset(keys[1], env_params),
            noise=exploration.draw(keys[2]),
            updates=update.draw(keys[3], subset),
        )

    def advance(
        state: TrainingState,
        pool: Transition | None,
        draws: _Draws,
        now: Plan,
        max_episodes: jax.Array | None,
    ) -> tuple[TrainingState, Log]:
        greedy = agent.act(state.agent, state.observation)
        action, log_density, exploration_state = exploration.perturb(
            state.exploration, greedy, draws.noise, now.step
        )
        env_state, step = env.step(draws.env, state.env, action, env_params)
        transition = Transition(
            state.observation, action, step.reward, step.observation, step.terminated
        )
        replay_state = replay.add(ReplayState(state.storage, now.step), transition)

        ended = step.terminated | step.truncated

        reward_state, sampler_state, reward_info = state.reward, state.sampler, None
        if sampler is not None:
            sampler_state = sampler.record(
                sampler_state, state.agent.actor, now.step, log_density, ended
            )

            samples = functools.partial(
                sampler.take,
                sampler_state,
                pool,
                state.subset,
                replay_state,
                exploration_state,
            )

            reward_state, reward_info = jax.lax.cond(
                now.learn_reward,
                lambda reward: update.update_reward(reward, samples, draws.updates),
                lambda reward: (reward, base.no_info()),
                reward_state,
            )

        if update.stores_shaped:
            # Algorithm 2: the reward learns first, then r* is stored. The same row is written over.
            shaped = update.shape(
                reward_state, transition, state.agent.hparams.discount, now.reward_weight
            )
            replay_state = replay.add(ReplayState(replay_state.storage, now.step), shaped)

        def learn(agent_state: DDPGState):
            agent_state, info = update.update_agent(
                agent_state, reward_state, pool, replay_state, draws.updates, now
            )
            return agent_state, info.critic_loss, info.q_mean

        agent_state, critic_loss, q_mean = jax.lax.cond(
            now.learn,
            learn,
            lambda agent_state: (agent_state, jnp.zeros(()), jnp.zeros(())),
            state.agent,
        )

        done = ended
        if max_episodes is not None:
            running = state.episode < max_episodes
            done = ended & running
            agent_state, reward_state = _keep_parameters(running, state, agent_state, reward_state)
        log = Log(
            done=done,
            terminated=step.terminated,
            episode_return=state.episode_return + step.reward,
            episode_length=state.episode_length + 1,
            learned=now.learn,
            critic_loss=critic_loss,
            q_mean=q_mean,
            reward_learned=now.learn_reward,
            reward=reward_info,
        )
        fresh_env, fresh_observation = draws.reset
        state = state.replace(
            agent=agent_state,
            reward=reward_state,
            storage=replay_state.storage,
            sampler=sampler_state,
            exploration=_select(ended, exploration.reset(exploration_state), exploration_state),
            env=_select(ended, fresh_env, env_state),
            observation=_select(ended, fresh_observation, step.observation),
            episode=state.episode + done,
            episode_return=jnp.where(ended, 0.0, log.episode_return),
            episode_length=jnp.where(ended, 0, log.episode_length),
        )
        return state, log

    def run(
        state: TrainingState,
        data: HotStartData | None,
        steps: jax.Array,
        max_episodes: Numeric | None = None,
    ) -> tuple[TrainingState, Log]:
        if not method.interacts:
            raise ValueError(f"{method.name} does not act: its hot start is all of it")
        pool = None if data is None else data.transition
        # A chunk's randomness is hashed in one vectorised go, not step by step.
        draws = jax.vmap(draw, in_axes=(None, None, 0))(state.key, state.subset, steps)

        def body(state: TrainingState, inputs: tuple[_Draws, Plan]):
            return advance(state, pool, *inputs, max_episodes)  # type: ignore[arg-type]

        plans = jax.vmap(
            lambda step: schedules.plan(step, settings.schedule, settings.reward_schedule)
        )(steps)
        return jax.lax.scan(body, state, (draws, plans))

    def act(params: Any, observation: jax.Array) -> jax.Array:
        return networks_lib.policy(agent.networks, params, observation)

    return Trainer(algorithm, beginning.draw_networks, beginning.init, run, act)


def _select(predicate: jax.Array, on_true: Any, on_false: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(predicate, x, y), on_true, on_false)


def _keep_parameters(
    running: jax.Array, before: TrainingState, agent: DDPGState, reward: RewardState | None
) -> tuple[DDPGState, RewardState | None]:
    """The parameters that are read later stay a stopped seed's own; its other state may move."""
    agent = agent.replace(
        actor=_select(running, agent.actor, before.agent.actor),
        critic=_select(running, agent.critic, before.agent.critic),
    )
    if reward is not None and before.reward is not None:
        reward = reward.replace(params=_select(running, reward.params, before.reward.params))
    return agent, reward
