"""Coverage distributions: the transitions on which rewards are compared."""

import jax
import jax.numpy as jnp

from cmedirl_jax.assess.distances import Coverage, Successor
from cmedirl_jax.envs import Env
from cmedirl_jax.types import Transition


def successor(env: Env) -> Successor:
    """The dynamics of a task that draws nothing, `(observation [O], action [A]) -> [O]`.

    Raises:
        ValueError: if the task cannot be set to an observation.
    """
    if env.state_at is None:
        raise ValueError(f"{env.spec.id} does not say which state an observation is of")
    state_at, params = env.state_at, env.default_params

    def follow(observation: jax.Array, action: jax.Array) -> jax.Array:
        state = state_at(observation, params)
        return env.step(jax.random.key(0), state, action, params)[1].observation

    return follow


def uniform(key: jax.Array, env: Env, count: int, draws: int) -> Coverage:
    """Observations and actions drawn uniformly within their bounds, and their successors.

    Args:
        key: randomness.
        env: a task that can be set to an observation; its bounds are finite.
        count: transitions N.
        draws: K.

    Raises:
        ValueError: as `successor`, or for a bound that is infinite.
    """
    spec, follow = env.spec, successor(env)
    bounds = (spec.observation_low, spec.observation_high)
    if not all(bool(jnp.isfinite(bound).all()) for bound in bounds):
        raise ValueError(f"{spec.id}: its observations have no finite bounds to draw within")
    keys = jax.random.split(key, 5)

    def observations(key: jax.Array, count: int) -> jax.Array:
        drawn = jax.random.uniform(key, (count, spec.observation_dim), jnp.float32, *bounds)
        # Observations of one state may be bound to each other, as a cosine and a sine are.
        idle = jnp.zeros((count, spec.action_dim), jnp.float32)
        return jax.vmap(follow)(drawn, idle)

    def actions(key: jax.Array, count: int) -> jax.Array:
        shape = (count, spec.action_dim)
        return jax.random.uniform(key, shape, jnp.float32, spec.action_low, spec.action_high)

    observation, action = observations(keys[0], count), actions(keys[1], count)
    return Coverage(
        observation,
        action,
        jax.vmap(follow)(observation, action),
        actions(keys[2], draws),
        observations(keys[3], draws),
        observations(keys[4], draws),
    )


def visited(key: jax.Array, transition: Transition, count: int, draws: int) -> Coverage:
    """Transitions that were made, by demonstrators or policies.

    Args:
        key: randomness.
        transition: leaves `[T, ...]`; each step is drawn alike.
        count: transitions N.
        draws: K.
    """
    size = jnp.shape(transition.reward)[0]
    keys = jax.random.split(key, 4)
    made = jax.random.randint(keys[0], (count,), 0, size)
    actions, observations, following = (
        jax.random.randint(each, (draws,), 0, size) for each in keys[1:]
    )
    observation, action, after = (
        jnp.asarray(leaf)
        for leaf in (transition.observation, transition.action, transition.next_observation)
    )
    return Coverage(
        observation[made],
        action[made],
        after[made],
        action[actions],
        observation[observations],
        after[following],
    )
