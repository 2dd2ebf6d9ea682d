"""PointMass-v0: a point is pushed through a walled square, around two discs, to a goal.

It is this project's own task, with two action dimensions. The square is [-1, 1]^2. A step is

    velocity <- clip(drag velocity + push action, -1, 1)
    position <- clip(position + dt velocity, -1, 1), and a wall stops the velocity towards it

and earns `goal_reward` where the new position is within `goal_radius` of the goal, which ends the
episode, less `action_cost` |action|^2, less `distance_cost` times the new distance to the goal,
less `obstacle_cost` where the new position is inside a disc. The discs stop nobody: they cost. The
action as given is charged, the clipped one pushes. The straight way to the goal leads through a
disc.
"""

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.envs.base import Env, Step, fixed_starts
from cmedirl_jax.types import Array, EnvSpec, Numeric


class PointMassParams(flax.struct.PyTreeNode):
    """Physics and costs, as traced leaves; lengths are half-widths of the square.

    Attributes:
        dt: duration of a step.
        drag: share of the velocity that a step keeps.
        push: velocity that a step of full action adds.
        goal: `[2]`, its position.
        goal_radius: how near counts.
        goal_reward: reward of reaching the goal.
        action_cost: cost of a step per squared action.
        distance_cost: cost of a step per distance to the goal.
        obstacles: `[K, 2]`, the centres of the discs.
        obstacle_radius: of each disc.
        obstacle_cost: of a step that ends in a disc.
        start: `[2]`, the centre of the square in which episodes start, at rest.
        start_width: half the width of that square.
        max_episode_steps: steps after which an episode is truncated.
    """

    dt: Numeric = 0.1
    drag: Numeric = 0.9
    push: Numeric = 0.2
    goal: Array = flax.struct.field(default_factory=lambda: np.array([0.7, 0.7], np.float32))
    goal_radius: Numeric = 0.15
    goal_reward: Numeric = 10.0
    action_cost: Numeric = 0.01
    distance_cost: Numeric = 0.1
    obstacles: Array = flax.struct.field(
        default_factory=lambda: np.array([[0.0, 0.0], [0.5, 0.1]], np.float32)
    )
    obstacle_radius: Numeric = 0.25
    obstacle_cost: Numeric = 0.5
    start: Array = flax.struct.field(default_factory=lambda: np.array([-0.7, -0.7], np.float32))
    start_width: Numeric = 0.2
    max_episode_steps: Numeric = 100


class PointMassState(flax.struct.PyTreeNode):
    """The point.

    Attributes:
        position: `[2]` float32.
        velocity: `[2]` float32.
        time: `[]` int32, steps of the episode so far.
    """

    position: jax.Array
    velocity: jax.Array
    time: jax.Array


SPEC = EnvSpec(
    id="PointMass-v0",
    observation_dim=4,
    action_dim=2,
    observation_low=np.full(4, -1.0, np.float32),
    observation_high=np.full(4, 1.0, np.float32),
    action_low=np.full(2, -1.0, np.float32),
    action_high=np.full(2, 1.0, np.float32),
    max_episode_steps=100,
    reward_threshold=None,
)


def make() -> Env:
    """Make the environment; observations are the position and the velocity."""
    return Env(SPEC, PointMassParams(), reset, step, fixed_starts(reset), state_at)


def reset(key: jax.Array, params: PointMassParams) -> tuple[PointMassState, jax.Array]:
    """Start at rest, uniformly in the square around `params.start`."""
    offset = jax.random.uniform(key, (2,), jnp.float32, minval=-1.0)
    position = jnp.asarray(params.start + params.start_width * offset, jnp.float32)
    state = PointMassState(position, jnp.zeros(2, jnp.float32), jnp.zeros((), jnp.int32))
    return state, _observe(state)


def step(
    key: jax.Array, state: PointMassState, action: jax.Array, params: PointMassParams
) -> tuple[PointMassState, Step]:
    """Advance the point by `action` `[2]`. It is deterministic and does not use `key`."""
    del key
    given = jnp.asarray(action, jnp.float32)
    pushed = params.push * jnp.clip(given, SPEC.action_low, SPEC.action_high)
    velocity = jnp.clip(params.drag * state.velocity + pushed, -1.0, 1.0)
    free = state.position + params.dt * velocity
    position = jnp.clip(free, -1.0, 1.0)
    velocity = jnp.where(free == position, velocity, 0.0)

    distance = jnp.linalg.norm(position - params.goal)
    terminated = distance <= params.goal_radius
    from_discs = jnp.linalg.norm(position - jnp.asarray(params.obstacles), axis=-1)
    inside = jnp.any(from_discs < params.obstacle_radius)
    reward = (
        params.goal_reward * terminated
        - params.action_cost * jnp.sum(jnp.square(given))
        - params.distance_cost * distance
        - params.obstacle_cost * inside
    )
    new_state = PointMassState(position, velocity, state.time + 1)
    truncated = new_state.time >= params.max_episode_steps
    return new_state, Step(_observe(new_state), reward, terminated, truncated)


def state_at(observation: jax.Array, params: PointMassParams) -> PointMassState:
    """The point at `observation` `[4]`, before its first step."""
    del params
    observation = jnp.asarray(observation, jnp.float32)
    return PointMassState(observation[:2], observation[2:], jnp.zeros((), jnp.int32))


def _observe(state: PointMassState) -> jax.Array:
    return jnp.concatenate([state.position, state.velocity])
