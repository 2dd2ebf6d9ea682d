"""Algorithm 2 for one seed, as functions that vmap over seeds.

    trainer = training.make(env, METHODS["hs-me-ddpg"], Settings(), capacity=12_000)
    states = jax.vmap(trainer.init, in_axes=(0, None, None))(keys, data, 200)
    states, log = jax.jit(jax.vmap(trainer.run, in_axes=(0, None, None)))(states, data, steps)

A step has two halves. `behave` gives the action of the behaviour policy. `learn` takes what the
task answered and does everything else. `run` scans both around `env.step`; a task that is not
written in JAX calls the halves itself.

Each step draws its randomness from `fold_in(seed's key, step)`. A seed's numbers therefore depend
neither on how many seeds run beside it nor on how its steps are cut into chunks.
"""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import envs
from cmedirl_jax import networks as networks_lib
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.training import compose, initialise, schedules, updates
from cmedirl_jax.training import step as step_lib
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.schedules import Plan
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.training.step import Behaviour, Log, StepDraws, StepParts
from cmedirl_jax.types import Numeric, Params


class Trainer(NamedTuple):
    """A method on an environment as pure functions of one seed.

    Under vmap leave `data`, `pool`, `plan`, `steps` and `max_episodes` unbatched: branches are
    taken by them.

    Attributes:
        algorithm: the method's parts.
        draw_networks: see `initialise.Initialisation`.
        hot_start: likewise.
        init: likewise.
        draw: `(key, subset, step, demonstrated=True) -> StepDraws`, of environment step number
            `step` `[]` int32 of the seed whose state has this `key` and this `subset`. Steps that
            learn nothing from demonstrations may say so by `demonstrated`, which spares the draws.
        plan: `(step) -> Plan`, what that step does.
        behave: `(state, draws, plan) -> Behaviour`, the first half of a step.
        learn: `(state, behaviour, answer, next_start, draws, plan, pool, max_episodes=None) ->
            (TrainingState, Log)`, the second half. `answer` is the task's `Step`; `next_start`
            `[O]` is the first observation of the next episode, read only if this one has ended;
            `pool` has the demonstrations' transitions `[N, ...]` or is None. The state of the
            environment is left as it is.
        run: `(state, data, steps, max_episodes=None) -> (TrainingState, Log)` for `steps` `[T]`
            int32, the numbers t, t + 1, ... of the environment steps to take. A seed that has
            finished `max_episodes` episodes learns no more.
        act: `(actor parameters, observation [..., O]) -> action [..., A]`, mu(s).
    """

    algorithm: Algorithm
    draw_networks: Callable[[jax.Array], tuple[Params, Params]]
    hot_start: Callable[..., tuple[Params, Params]]
    init: Callable[..., TrainingState]
    draw: Callable[..., StepDraws]
    plan: Callable[[jax.Array], Plan]
    behave: Callable[[TrainingState, StepDraws, Plan], Behaviour]
    learn: Callable[..., tuple[TrainingState, Log]]
    run: Callable[..., tuple[TrainingState, Log]]
    act: Callable[[Params, jax.Array], jax.Array]


def make(
    env: Env | HostEnv,
    method: Method,
    settings: Settings | None = None,
    *,
    capacity: int,
    env_params: Any = None,
    subset_size: int | None = None,
) -> Trainer:
    """Make a trainer.

    Args:
        env: the environment. For one that is stepped on the host `run` raises ValueError: see
            `training.host`.
        method: one of `METHODS`, or your own.
        settings: every other choice.
        capacity: transitions in the replay where `settings.schedule` leaves it open.
        env_params: default `env.default_params`.
        subset_size: pad each seed's subset to this many demonstrations, so that their number may be
            traced: one program for every number of demonstrations.

    Raises:
        ValueError: for a method without networks (`tabular.imitation` fits those), a tabular reward
            of a task on the host, an environment that does not keep to its specification, numbers
            out of their range, or settings that do not fit each other.
        TypeError: for an environment of other dtypes.
    """
    if method.tabular and not method.interacts:
        raise ValueError(f"{method.name} does not act: there is nothing to train")
    settings = settings or Settings()
    if isinstance(env, Env):
        env_params = env.default_params if env_params is None else env_params
        envs.check(env, env_params, steps=0)
    elif method.tabular:
        raise ValueError(f"{method.name} puts the task on a grid, {env.spec.id} is not in JAX")
    algorithm = compose.compose(env.spec, method, settings, capacity)
    beginning = initialise.make(
        env, method, settings, algorithm, env_params=env_params, subset_size=subset_size
    )
    plan = functools.partial(
        schedules.plan, schedule=settings.schedule, reward_schedule=settings.reward_schedule
    )
    update_parts = updates.make_parts(algorithm, method, settings)
    parts = StepParts(algorithm, update_parts, env.spec.max_episode_steps)
    if not method.interacts:
        run = functools.partial(
            _refuse_to_run, f"{method.name} does not act: its hot start is all of it"
        )
    elif isinstance(env, Env):
        run = functools.partial(_run, parts, env, env_params, plan)
    else:
        run = functools.partial(
            _refuse_to_run, f"{env.spec.id} is stepped on the host: see training.host"
        )
    return Trainer(
        algorithm=algorithm,
        draw_networks=beginning.draw_networks,
        hot_start=beginning.hot_start,
        init=beginning.init,
        draw=functools.partial(step_lib.draw, parts),
        plan=plan,
        behave=functools.partial(step_lib.behave, parts),
        learn=functools.partial(step_lib.learn, parts),
        run=run,
        act=functools.partial(networks_lib.policy, algorithm.agent.networks),
    )


def _run(
    parts: StepParts,
    env: Env,
    env_params: Any,
    plan: Callable[[jax.Array], Plan],
    state: TrainingState,
    data: HotStartData | None,
    steps: jax.Array,
    max_episodes: Numeric | None = None,
) -> tuple[TrainingState, Log]:
    pool = None if data is None else data.transition
    # One vectorised call hashes a chunk's randomness faster than one call per step.
    keys = jax.vmap(step_lib.step_keys, in_axes=(None, 0))(state.key, steps)
    plans = jax.vmap(plan)(steps)
    demonstrated = jnp.any(plans.learn_reward | (plans.cloning_weight > 0.0))
    draws = jax.vmap(
        lambda step: step_lib.draw(parts, state.key, state.subset, step, demonstrated)
    )(steps)
    starts = jax.vmap(env.reset, in_axes=(0, None))(keys[:, 1], env_params)

    def advance(state: TrainingState, inputs: Any) -> tuple[TrainingState, Log]:
        env_key, start, draws, now = inputs
        behaviour = step_lib.behave(parts, state, draws, now)
        env_state, answer = env.step(env_key, state.env, behaviour.action, env_params)
        first_state, first_observation = start
        ended = step_lib.has_ended(parts, state, answer)
        state, log = step_lib.learn(
            parts, state, behaviour, answer, first_observation, draws, now, pool, max_episodes
        )
        return state.replace(env=step_lib.select(ended, first_state, env_state)), log

    return jax.lax.scan(advance, state, (keys[:, 0], starts, draws, plans))


def _refuse_to_run(why: str, *_: Any, **__: Any) -> Any:
    raise ValueError(why)
