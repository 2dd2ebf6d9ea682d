"""Algorithm 2 for one seed, as functions that vmap over seeds; `fit` for those who want one call.

    trainer = training.make(env, METHODS["hs-me-ddpg"], Settings(), capacity=12_000)
    states = jax.vmap(trainer.init, in_axes=(0, None, None))(keys, data, 200)
    states, log = jax.jit(jax.vmap(trainer.run, in_axes=(0, None, 0)))(states, data, steps)

Every step's randomness is drawn from `fold_in(seed's key, step)`, so that what a seed does depends
neither on how many seeds run beside it nor on how its steps are cut into chunks.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax import demonstrations as demonstrations_lib
from cmedirl_jax import evaluation, hot_start, methods, shaping
from cmedirl_jax import seeds as seeds_lib
from cmedirl_jax.ddpg import DDPGState
from cmedirl_jax.demonstrations import Demonstrations, DemonstrationSubset
from cmedirl_jax.envs import Env
from cmedirl_jax.evaluation import Evaluation
from cmedirl_jax.hot_start import HotStartData
from cmedirl_jax.irl import RewardState
from cmedirl_jax.methods import Algorithm, Method, Settings
from cmedirl_jax.replay import ReplayState
from cmedirl_jax.types import Numeric, Transition


class TrainingState(flax.struct.PyTreeNode):
    """One seed.

    Attributes:
        key: the seed's own key; never advanced, steps fold into it.
        agent: DDPG's state.
        reward: the learned reward's state, or None.
        storage: `[capacity, D]`, the replay's rows; its count is the number of steps taken.
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
    exploration: Any
    env: Any
    observation: jax.Array
    episode: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    subset: DemonstrationSubset | None


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
    """

    done: jax.Array
    terminated: jax.Array
    episode_return: jax.Array
    episode_length: jax.Array
    learned: jax.Array
    critic_loss: jax.Array
    q_mean: jax.Array


class Trainer(NamedTuple):
    """A method on an environment as pure functions of one seed.

    Attributes:
        algorithm: the method's parts.
        init: `(key, data, n_demonstrations) -> TrainingState`, hot start included. `data` is what
            `hot_start.data` made of the pool, or None for methods without demonstrations.
        run: `(state, data, steps, max_episodes=None) -> (TrainingState, Log)` for `steps` `[T]`
            int32, the numbers t, t + 1, ... of the environment steps to take. Under vmap leave
            `data`, `steps` and `max_episodes` unbatched: branches are taken by them. A seed that
            has finished `max_episodes` episodes learns no more.
        act: `(actor parameters, observation [..., O]) -> action [..., A]`, mu(s).
    """

    algorithm: Algorithm
    init: Callable[..., TrainingState]
    run: Callable[..., tuple[TrainingState, Log]]
    act: Callable[..., jax.Array]


class _Draws(NamedTuple):
    """All randomness of a step."""

    env: jax.Array
    reset: jax.Array
    noise: Any
    batch: jax.Array
    background: jax.Array
    demonstrations: jax.Array


class _Schedule(NamedTuple):
    """What a step does, the same for every seed."""

    step: jax.Array
    learn: jax.Array
    update_targets: jax.Array
    learn_reward: jax.Array
    reward_weight: jax.Array
    cloning_weight: jax.Array


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
    """
    settings = settings or Settings()
    env_params = env.default_params if env_params is None else env_params
    algorithm = methods.compose(env.spec, method, settings, capacity)
    agent, learner, exploration, replay = algorithm
    schedule, reward_schedule = settings.schedule, settings.reward_schedule
    clones = method.hot_start and settings.agent.behaviour_cloning > 0
    stores_shaped = learner is not None and reward_schedule.storage == "store"

    def init(key: jax.Array, data: HotStartData | None, n_demonstrations: Numeric) -> TrainingState:
        agent_key, fit_key, reward_key, env_key, noise_key, subset_key = jax.random.split(key, 6)
        state = agent.init(agent_key)
        subset = None
        if method.uses_demonstrations:
            if data is None:
                raise ValueError(f"{method.name} needs demonstrations")
            subset = demonstrations_lib.subset(
                subset_key, data.episodes, n_demonstrations, subset_size
            )
        if method.hot_start:
            params = hot_start.fit(
                fit_key,
                agent.networks,
                (state.actor, state.critic),
                data,  # type: ignore[arg-type]
                settings.hot_start,
                subset=subset,
            )
            state = agent.init(agent_key, params)
        env_state, observation = env.reset(env_key, env_params)
        return TrainingState(
            key=key,
            agent=state,
            reward=learner.init(reward_key) if learner else None,
            storage=replay.init().storage,
            exploration=exploration.init(noise_key),
            env=env_state,
            observation=observation,
            episode=jnp.zeros((), jnp.int32),
            episode_return=jnp.zeros(()),
            episode_length=jnp.zeros((), jnp.int32),
            subset=subset,
        )

    def draw(key: jax.Array, subset: DemonstrationSubset | None, step: jax.Array) -> _Draws:
        keys = jax.random.split(jax.random.fold_in(key, step), 6)
        empty = jnp.zeros((0,), jnp.uint32)
        reward_batch = reward_schedule.iterations * reward_schedule.batch_size
        demonstrated = max(reward_batch, schedule.batch_size) if clones else reward_batch
        return _Draws(
            env=keys[0],
            reset=keys[1],
            noise=exploration.draw(keys[2]),
            batch=replay.draw(keys[3], schedule.batch_size),
            background=replay.draw(keys[4], reward_batch) if learner else empty,
            demonstrations=demonstrations_lib.sample_index(keys[5], subset, demonstrated)
            if subset is not None
            else empty,
        )

    def plan(step: jax.Array) -> _Schedule:
        learn = step >= schedule.learning_starts
        learn_reward = learn & (step % reward_schedule.period == 0)
        if reward_schedule.stop is not None:
            learn_reward &= step < reward_schedule.stop
        reward_weight = jnp.ones_like(step, jnp.float32)
        if reward_schedule.anneal_steps is not None:
            reward_weight = jnp.maximum(1.0 - step / reward_schedule.anneal_steps, 0.0)
        return _Schedule(
            step=step,
            learn=learn & (step % schedule.update_period == 0),
            update_targets=step % schedule.target_period == 0,
            learn_reward=learn_reward,
            reward_weight=reward_weight,
            cloning_weight=jnp.maximum(1.0 - step / schedule.behaviour_cloning_steps, 0.0),
        )

    def shaped(reward_state: RewardState | None, batch: Transition, weight: jax.Array):
        if learner is None or reward_state is None:
            return batch
        r_d = learner.reward(reward_state, batch.observation, batch.action)
        return batch._replace(reward=shaping.additive(batch.reward, r_d, weight))

    def learn_reward(
        reward_state: RewardState,
        pool: Transition,
        replay_state: ReplayState,
        draws: _Draws,
    ) -> RewardState:
        size = reward_schedule.batch_size
        for k in range(reward_schedule.iterations):
            rows = slice(k * size, (k + 1) * size)
            reward_state, _ = learner.update(  # type: ignore[union-attr]
                reward_state,
                _rows(pool, draws.demonstrations[rows]),
                replay.take(replay_state, draws.background[rows], reward_schedule.recent),
            )
        return reward_state

    def learn(
        agent_state: DDPGState,
        reward_state: RewardState | None,
        pool: Transition | None,
        replay_state: ReplayState,
        draws: _Draws,
        now: _Schedule,
    ):
        batch = replay.take(replay_state, draws.batch)
        if not stores_shaped:
            batch = shaped(reward_state, batch, now.reward_weight)
        if not clones:
            return agent.update(agent_state, batch, update_targets=now.update_targets)
        hparams = agent_state.hparams
        weight = hparams.behaviour_cloning
        agent_state, info = agent.update(
            agent_state.replace(
                hparams=hparams.replace(behaviour_cloning=weight * now.cloning_weight)
            ),
            batch,
            _rows(pool, draws.demonstrations[: schedule.batch_size]),
            update_targets=now.update_targets,
        )
        return agent_state.replace(hparams=hparams), info

    def advance(
        state: TrainingState,
        pool: Transition | None,
        draws: _Draws,
        now: _Schedule,
        max_episodes: jax.Array | None,
    ) -> tuple[TrainingState, Log]:
        greedy = agent.act(state.agent, state.observation)
        action, _, exploration_state = exploration.perturb(
            state.exploration, greedy, draws.noise, now.step
        )
        env_state, step = env.step(draws.env, state.env, action, env_params)
        transition = Transition(
            state.observation, action, step.reward, step.observation, step.terminated
        )
        if stores_shaped:
            transition = shaped(state.reward, transition, now.reward_weight)
        replay_state = replay.add(ReplayState(state.storage, now.step), transition)

        reward_state = state.reward
        if learner is not None:
            reward_state = jax.lax.cond(
                now.learn_reward,
                lambda reward_state: learn_reward(reward_state, pool, replay_state, draws),  # type: ignore[arg-type]
                lambda reward_state: reward_state,
                reward_state,
            )
        agent_state, critic_loss, q_mean = jax.lax.cond(
            now.learn,
            lambda agent_state: _with_metrics(
                *learn(agent_state, reward_state, pool, replay_state, draws, now)
            ),
            lambda agent_state: (agent_state, jnp.zeros(()), jnp.zeros(())),
            state.agent,
        )

        done = step.terminated | step.truncated
        log = Log(
            done=done if max_episodes is None else done & (state.episode < max_episodes),
            terminated=step.terminated,
            episode_return=state.episode_return + step.reward,
            episode_length=state.episode_length + 1,
            learned=now.learn,
            critic_loss=critic_loss,
            q_mean=q_mean,
        )
        fresh_env, fresh_observation = env.reset(draws.reset, env_params)
        state = state.replace(
            agent=agent_state,
            reward=reward_state,
            storage=replay_state.storage,
            exploration=_select(done, exploration.reset(exploration_state), exploration_state),
            env=_select(done, fresh_env, env_state),
            observation=_select(done, fresh_observation, step.observation),
            episode=state.episode + log.done,
            episode_return=jnp.where(done, 0.0, log.episode_return),
            episode_length=jnp.where(done, 0, log.episode_length),
        )
        if max_episodes is not None:
            state = _stop_learning(state, state.episode >= max_episodes)
        return state, log

    def run(
        state: TrainingState,
        data: HotStartData | None,
        steps: jax.Array,
        max_episodes: Numeric | None = None,
    ) -> tuple[TrainingState, Log]:
        pool = None if data is None else data.transition
        # Hashing a chunk's randomness in one go costs a tenth of hashing it step by step.
        draws = jax.vmap(draw, in_axes=(None, None, 0))(state.key, state.subset, steps)

        def body(state: TrainingState, inputs: tuple[_Draws, _Schedule]):
            return advance(state, pool, *inputs, max_episodes)  # type: ignore[arg-type]

        return jax.lax.scan(body, state, (draws, jax.vmap(plan)(steps)))

    def act(params: Any, observation: jax.Array) -> jax.Array:
        networks = agent.networks
        return networks.squash(networks.actor.apply(params, observation))

    return Trainer(algorithm, init, run, act)


class Result(NamedTuple):
    """What `fit` returns, every leaf with a leading axis of seeds.

    Attributes:
        states: the final training states `[seeds, ...]`.
        evaluations: `[seeds, 1 + steps // evaluate_every]`, the first before any step.
        episodes: the step-wise log `[seeds, steps]`.
    """

    states: TrainingState
    evaluations: Evaluation
    episodes: Log


def fit(
    key: jax.Array,
    env: Env,
    method: Method | str,
    demonstrations: Demonstrations | None = None,
    *,
    seeds: int,
    steps: int,
    n_demonstrations: int | None = None,
    settings: Settings | None = None,
    evaluate_every: int = 250,
    evaluation_starts: int = 10,
) -> Result:
    """Train `seeds` independent learners and evaluate them as they go. Jittable; jits nothing.

    Args:
        key: seed i learns from `fold_in(key, i)`.
        env: the environment.
        method: a `Method`, or the name of one of `METHODS`.
        demonstrations: the pool, for methods that use one.
        seeds: how many learners.
        steps: environment steps of each; a multiple of `evaluate_every`.
        n_demonstrations: episodes that each learner draws from the pool; default all.
        settings: every other choice.
        evaluate_every: steps between evaluations.
        evaluation_starts: start states per evaluation.

    Raises:
        ValueError: for an unknown method, missing demonstrations, or `steps` that are no multiple.
    """
    if isinstance(method, str):
        if method not in methods.METHODS:
            raise ValueError(f"unknown method {method!r}; there are: {', '.join(methods.METHODS)}")
        method = methods.METHODS[method]
    if steps % evaluate_every:
        raise ValueError(f"steps ({steps}) must be a multiple of evaluate_every ({evaluate_every})")
    settings = settings or Settings()
    data, n = None, 0
    if demonstrations is not None and method.uses_demonstrations:
        data = hot_start.data(demonstrations, settings.hot_start.discount)
        n = n_demonstrations or len(data.episodes.start)
    trainer = make(env, method, settings, capacity=steps)

    def evaluate(state: TrainingState) -> Evaluation:
        return evaluation.evaluate(
            lambda observation: trainer.act(state.agent.actor, observation),
            env,
            env.default_params,
            evaluation_starts,
        )

    def learn(key: jax.Array) -> Result:
        state = trainer.init(key, data, n)
        first = evaluate(state)

        def chunk(state: TrainingState, steps: jax.Array):
            state, log = trainer.run(state, data, steps)
            return state, (evaluate(state), log)

        chunks = jnp.arange(steps).reshape(-1, evaluate_every)
        state, (later, log) = jax.lax.scan(chunk, state, chunks)
        evaluations = jax.tree.map(lambda x, xs: jnp.concatenate([x[None], xs]), first, later)
        return Result(state, evaluations, jax.tree.map(lambda x: x.reshape(steps), log))

    group = seeds_lib.group_size(seeds, width=max(settings.architecture.hidden))
    keys = seeds_lib.keys(key, seeds_lib.padded(seeds, group))
    result = seeds_lib.map_groups(learn, group)(keys)
    return jax.tree.map(lambda x: x[:seeds], result)


def _with_metrics(agent_state: DDPGState, info):
    return agent_state, info.critic_loss, info.q_mean


def _rows(pool: Any, index: jax.Array) -> Any:
    return jax.tree.map(lambda leaf: jnp.asarray(leaf)[index], pool)


def _select(predicate: jax.Array, on_true: Any, on_false: Any) -> Any:
    return jax.tree.map(lambda x, y: jnp.where(predicate, x, y), on_true, on_false)


def _stop_learning(state: TrainingState, stopped: jax.Array) -> TrainingState:
    """Set a stopped seed's learning rates to zero: cheaper than a select over every parameter."""
    goes_on = 1.0 - stopped.astype(jnp.float32)
    hparams = state.agent.hparams
    agent = state.agent.replace(
        hparams=hparams.replace(
            actor_learning_rate=hparams.actor_learning_rate * goes_on,
            critic_learning_rate=hparams.critic_learning_rate * goes_on,
        )
    )
    if state.reward is None:
        return state.replace(agent=agent)
    hparams = state.reward.hparams
    reward = state.reward.replace(
        hparams=hparams.replace(learning_rate=hparams.learning_rate * goes_on)
    )
    return state.replace(agent=agent, reward=reward)
