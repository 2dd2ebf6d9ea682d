"""Pendulum-v1 in pure JAX, equal to Gymnasium's step by step.

Source: Gymnasium 1.4.0, `gymnasium/envs/classic_control/pendulum.py`. Force and cost use the
clipped action. The angle is not wrapped, so that the state is Gymnasium's; the cost wraps it. The
task never terminates. Gymnasium computes in double precision; this version is float32.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.envs.base import Env, Step, fixed_starts
from cmedirl_jax.types import EnvSpec, Numeric


class PendulumParams(flax.struct.PyTreeNode):
    """Physics, as traced leaves, in SI units.

    Attributes:
        max_speed: largest magnitude of the angular velocity, rad / s.
        max_torque: largest magnitude of the torque that an action gives, N m.
        dt: duration of a step, s.
        gravity: m / s^2.
        mass: of the rod, kg.
        length: of the rod, m.
        speed_cost: cost of a step per squared angular velocity.
        torque_cost: cost of a step per squared torque.
        start_angle: largest magnitude of the start angle, rad; 0 is upright.
        start_speed: largest magnitude of the angular velocity at the start, rad / s.
        max_episode_steps: steps after which an episode is truncated.
    """

    max_speed: Numeric = 8.0
    max_torque: Numeric = 2.0
    dt: Numeric = 0.05
    gravity: Numeric = 10.0
    mass: Numeric = 1.0
    length: Numeric = 1.0
    speed_cost: Numeric = 0.1
    torque_cost: Numeric = 0.001
    start_angle: Numeric = float(np.pi)
    start_speed: Numeric = 1.0
    max_episode_steps: Numeric = 200


class PendulumState(flax.struct.PyTreeNode):
    """The pendulum.

    Attributes:
        angle: `[]` float32, rad from upright, not wrapped.
        speed: `[]` float32, rad / s.
        time: `[]` int32, steps of the episode so far.
    """

    angle: jax.Array
    speed: jax.Array
    time: jax.Array


SPEC = EnvSpec(
    id="Pendulum-v1",
    observation_dim=3,
    action_dim=1,
    observation_low=np.array([-1.0, -1.0, -8.0], np.float32),
    observation_high=np.array([1.0, 1.0, 8.0], np.float32),
    action_low=np.array([-2.0], np.float32),
    action_high=np.array([2.0], np.float32),
    max_episode_steps=200,
    reward_threshold=None,
)


def make() -> Env:
    """Make the environment; Gymnasium's physics are its default parameters."""
    return Env(SPEC, PendulumParams(), reset, step, fixed_starts(reset), state_at, gymnasium_state)


def reset(key: jax.Array, params: PendulumParams) -> tuple[PendulumState, jax.Array]:
    """Start at an angle from U(-start_angle, start_angle) and a speed drawn likewise."""
    angle, speed = jax.random.uniform(key, (2,), jnp.float32, minval=-1.0)
    state = PendulumState(
        jnp.asarray(angle * params.start_angle, jnp.float32),
        jnp.asarray(speed * params.start_speed, jnp.float32),
        jnp.zeros((), jnp.int32),
    )
    return state, _observe(state)


def step(
    key: jax.Array, state: PendulumState, action: jax.Array, params: PendulumParams
) -> tuple[PendulumState, Step]:
    """Advance the pendulum by `action` `[1]`, a torque. It does not use `key`."""
    del key
    torque = jnp.clip(jnp.asarray(action[0], jnp.float32), -params.max_torque, params.max_torque)
    wrapped = (state.angle + jnp.pi) % (2.0 * jnp.pi) - jnp.pi
    cost = (
        jnp.square(wrapped)
        + params.speed_cost * jnp.square(state.speed)
        + params.torque_cost * jnp.square(torque)
    )
    acceleration = 1.5 * params.gravity / params.length * jnp.sin(state.angle) + (
        3.0 / (params.mass * params.length**2) * torque
    )
    speed = jnp.clip(state.speed + acceleration * params.dt, -params.max_speed, params.max_speed)
    new_state = PendulumState(state.angle + speed * params.dt, speed, state.time + 1)
    truncated = new_state.time >= params.max_episode_steps
    return new_state, Step(_observe(new_state), -cost, jnp.zeros((), bool), truncated)


def state_at(observation: jax.Array, params: PendulumParams) -> PendulumState:
    """The pendulum at `observation` `[3]`, its angle within (-pi, pi], before its first step."""
    del params
    cosine, sine, speed = jnp.asarray(observation, jnp.float32)
    return PendulumState(jnp.arctan2(sine, cosine), speed, jnp.zeros((), jnp.int32))


def gymnasium_state(state: PendulumState) -> np.ndarray:
    """`[2]` or `[..., 2]`, the `state` attribute of Gymnasium's environment."""
    return np.stack([np.asarray(state.angle), np.asarray(state.speed)], axis=-1)


def _observe(state: PendulumState) -> jax.Array:
    return jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), state.speed])
