"""Coverage distributions: the transitions on which rewards are compared."""

import functools

import jax
import jax.numpy as jnp

from cmedirl_jax import normalisation
from cmedirl_jax.assess.distances import Coverage, Successor
from cmedirl_jax.envs import Env
from cmedirl_jax.envs.base import step_from
from cmedirl_jax.types import Transition

OVERSAMPLING = 4
"""Draws for each observation in which the episode is to go on."""


def successor(env: Env) -> Successor:
    """The dynamics of a task that draws nothing, `(observation [O], action [A]) -> [O]`.

    Raises:
        ValueError: if the task cannot be set to an observation.
    """
    if env.state_at is None:
        raise ValueError(f"{env.spec.id} does not say which state an observation is of")
    step = functools.partial(step_from, env, env.default_params)
    return lambda observation, action: step(observation, action).observation


def uniform(key: jax.Array, env: Env, count: int, draws: int) -> Coverage:
    """Observations and actions spread over their bounds, and their successors.

    No observation is that of an episode's end, of which rewards are never asked.

    Args:
        key: randomness.
        env: a task that can be set to an observation; its bounds are finite.
        count: transitions N.
        draws: K.

    Raises:
        ValueError: as `successor`, or for a bound that is infinite.
    """
    spec, follow = env.spec, successor(env)
    if not normalisation.sensible(spec).all():
        raise ValueError(f"{spec.id}: its observations have no finite bounds to draw within")
    keys = jax.random.split(key, 5)
    observation, action = _live(keys[0], env, count), _actions(keys[1], env, count)
    return Coverage(
        observation,
        action,
        jax.vmap(follow)(observation, action),
        _actions(keys[2], env, draws),
        _live(keys[3], env, draws),
        _live(keys[4], env, draws),
    )


def _actions(key: jax.Array, env: Env, count: int) -> jax.Array:
    low, high = env.spec.action_low, env.spec.action_high
    return jax.random.uniform(key, (count, env.spec.action_dim), jnp.float32, low, high)


def _live(key: jax.Array, env: Env, count: int) -> jax.Array:
    """Observations in which an episode goes on: successors of uniform draws that did not end it.

    A step also makes observations of a state that draws are not, such as a cosine and a sine.
    """
    spec, keys = env.spec, jax.random.split(key)
    shape = (OVERSAMPLING * count, spec.observation_dim)
    bounds = spec.observation_low, spec.observation_high
    drawn = jax.random.uniform(keys[0], shape, jnp.float32, *bounds)

    step = jax.vmap(functools.partial(step_from, env, env.default_params))
    answer = step(drawn, _actions(keys[1], env, len(drawn)))
    # Those that go on come first; were they fewer than asked for, they would be taken again.
    going_on = jnp.maximum(jnp.sum(~answer.terminated), 1)
    order = jnp.argsort(answer.terminated, stable=True)
    return answer.observation[order[jnp.arange(count) % going_on]]


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
