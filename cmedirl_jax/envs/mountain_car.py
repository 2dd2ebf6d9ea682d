"""MountainCarContinuous-v0 in pure JAX, equal to Gymnasium's step by step.

Source: Gymnasium 1.4.0, `gymnasium/envs/classic_control/continuous_mountain_car.py`. Two details
that other ports miss: the *force* uses the clipped action while the *cost* uses the action as
given, and the velocity is zeroed at the left wall (not at the goal). Gymnasium evaluates the cosine
in double precision; this version is float32 throughout and agrees within float32 rounding.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.envs.base import Env, Step
from cmedirl_jax.types import EnvSpec, Numeric


class MountainCarParams(flax.struct.PyTreeNode):
    """Physics, as traced leaves, in Gymnasium's units of position; velocities are per step.

    Attributes:
        power: velocity that a step of full force adds.
        gravity: largest velocity that a step on the slope adds.
        max_speed: largest magnitude of the velocity.
        min_position: the left wall, where the car stops.
        max_position: the right end.
        goal_position: least position of the goal.
        goal_velocity: least velocity at the goal.
        goal_reward: reward of reaching the goal.
        action_cost: cost of a step per squared action.
        start_low: least start position.
        start_high: largest start position.
        max_episode_steps: steps after which an episode is truncated.
    """

    power: Numeric = 0.0015
    gravity: Numeric = 0.0025
    max_speed: Numeric = 0.07
    min_position: Numeric = -1.2
    max_position: Numeric = 0.6
    goal_position: Numeric = 0.45
    goal_velocity: Numeric = 0.0
    goal_reward: Numeric = 100.0
    action_cost: Numeric = 0.1
    start_low: Numeric = -0.6
    start_high: Numeric = -0.4
    max_episode_steps: Numeric = 999


class MountainCarState(flax.struct.PyTreeNode):
    """The car.

    Attributes:
        position: `[]` float32.
        velocity: `[]` float32, change of the position per step.
        time: `[]` int32, steps of the episode so far.
    """

    position: jax.Array
    velocity: jax.Array
    time: jax.Array


SPEC = EnvSpec(
    id="MountainCarContinuous-v0",
    observation_dim=2,
    action_dim=1,
    observation_low=np.array([-1.2, -0.07], np.float32),
    observation_high=np.array([0.6, 0.07], np.float32),
    action_low=np.array([-1.0], np.float32),
    action_high=np.array([1.0], np.float32),
    max_episode_steps=999,
    reward_threshold=90.0,
)


def make() -> Env:
    """Make the environment; Gymnasium's physics are its default parameters."""
    return Env(SPEC, MountainCarParams(), reset, step, starts, state_at, gymnasium_state)


def reset(key: jax.Array, params: MountainCarParams) -> tuple[MountainCarState, jax.Array]:
    """Start at rest, at a position drawn from U(start_low, start_high)."""
    position = jax.random.uniform(
        key, dtype=jnp.float32, minval=params.start_low, maxval=params.start_high
    )
    return _at_rest(position)


def starts(count: int, params: MountainCarParams) -> tuple[MountainCarState, jax.Array]:
    """`count` start states at rest, the midpoints of as many equal parts of the start interval.

    Their mean weighs the interval as `reset` draws it. Its ends would weigh too much.
    """
    share = (jnp.arange(count, dtype=jnp.float32) + 0.5) / count
    return jax.vmap(_at_rest)(params.start_low + share * (params.start_high - params.start_low))


def step(
    key: jax.Array, state: MountainCarState, action: jax.Array, params: MountainCarParams
) -> tuple[MountainCarState, Step]:
    """Advance the car by `action` `[1]`. It is deterministic and does not use `key`."""
    del key
    push = jnp.asarray(action[0], jnp.float32)
    force = jnp.clip(push, SPEC.action_low[0], SPEC.action_high[0])
    velocity = state.velocity + (
        force * params.power - params.gravity * jnp.cos(3.0 * state.position)
    )
    velocity = jnp.clip(velocity, -params.max_speed, params.max_speed)
    position = jnp.clip(state.position + velocity, params.min_position, params.max_position)
    velocity = jnp.where((position == params.min_position) & (velocity < 0), 0.0, velocity)
    terminated = (position >= params.goal_position) & (velocity >= params.goal_velocity)
    reward = params.goal_reward * terminated - params.action_cost * jnp.square(push)
    new_state = MountainCarState(position, velocity, state.time + 1)
    truncated = new_state.time >= params.max_episode_steps
    return new_state, Step(_observe(new_state), reward, terminated, truncated)


def state_at(observation: jax.Array, params: MountainCarParams) -> MountainCarState:
    """The car at `observation` `[2]`, before its first step."""
    del params
    observation = jnp.asarray(observation, jnp.float32)
    return MountainCarState(observation[0], observation[1], jnp.zeros((), jnp.int32))


def gymnasium_state(state: MountainCarState) -> np.ndarray:
    """`[2]` or `[..., 2]`, the `state` attribute of Gymnasium's environment."""
    return np.stack([np.asarray(state.position), np.asarray(state.velocity)], axis=-1)


def _at_rest(position: jax.Array) -> tuple[MountainCarState, jax.Array]:
    observation = jnp.stack([position, jnp.zeros_like(position)])
    return MountainCarState(position, observation[1], jnp.zeros((), jnp.int32)), observation


def _observe(state: MountainCarState) -> jax.Array:
    return jnp.stack([state.position, state.velocity])
