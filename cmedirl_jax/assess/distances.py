"""Distances between rewards: 0 where they order all policies alike, about 0.71 where unrelated.

    canonical = distances.epic(reward, coverage, discount=0.99)
    distance = distances.pearson(canonical, distances.epic(other, coverage, discount=0.99))

A canonical form takes out of a reward what changes no policy's rank: potential-based shaping (Ng et
al. 1999). The distance between two forms is blind to their scales and, by Pearson's correlation, to
constants. EPIC and DARD know no end of an episode: a constant counts as nothing, even where it
makes never arriving the best policy. STARC on a grid with an absorbing state tells.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax.tabular import dynamics as dynamics_lib
from cmedirl_jax.tabular.dynamics import Dynamics
from cmedirl_jax.types import Array, Numeric

Reward = Callable[[jax.Array, jax.Array, jax.Array], jax.Array]
"""`(observation [..., O], action [..., A], next_observation [..., O]) -> [...]`."""
Successor = Callable[[jax.Array, jax.Array], jax.Array]
"""`(observation [O], action [A]) -> next_observation [O]`, of a task that draws nothing."""


class Coverage(NamedTuple):
    """On which transitions rewards are compared, and what their canonical forms average over.

    Attributes:
        observation: `[N, O]`, of the compared transitions.
        action: `[N, A]`.
        next_observation: `[N, O]`.
        actions: `[K, A]`, draws from the distribution of actions D_A.
        observations: `[K, O]`, draws from that of observations D_S.
        next_observations: `[K, O]`, independent ones, which EPIC takes for successors.
    """

    observation: Array
    action: Array
    next_observation: Array
    actions: Array
    observations: Array
    next_observations: Array


def epic(reward: Reward, coverage: Coverage, discount: Numeric) -> jax.Array:
    """The canonically shaped reward of the compared transitions, `[N]` (Gleave et al. 2021).

    C(s, a, s') = R(s, a, s') + E[gamma R(s', A, S') - R(s, A, S') - gamma R(S, A, S')]

    with A from D_A and S, S' from D_S. The draws are the same for every transition, so that the
    form of a shaped reward differs by a constant alone, however few they are.

    Args:
        reward: R.
        coverage: the transitions and the draws.
        discount: gamma.
    """
    made = jnp.asarray(coverage.observation), jnp.asarray(coverage.next_observation)
    actions, following = jnp.asarray(coverage.actions), jnp.asarray(coverage.next_observations)

    def mean_from(observation: jax.Array) -> jax.Array:
        """E[R(observation, A, S')]."""
        return jnp.mean(reward(jnp.broadcast_to(observation, following.shape), actions, following))

    before, after = (jax.lax.map(mean_from, each) for each in made)
    overall = jnp.mean(jax.lax.map(mean_from, jnp.asarray(coverage.observations)))
    given = reward(made[0], jnp.asarray(coverage.action), made[1])
    return given + discount * after - before - discount * overall


def dard(reward: Reward, successor: Successor, coverage: Coverage, discount: Numeric) -> jax.Array:
    """The dynamics-aware transformation of the compared transitions, `[N]` (Wulfe et al. 2022).

    C(s, a, s') = R(s, a, s') + E[gamma R(s', A, S'') - R(s, A, S') - gamma R(S', A, S'')]

    with A from D_A, S' the successor of (s, A) and S'' that of (s', A): rewards are asked about
    transitions near those that there are.

    Args:
        reward: R.
        successor: the task's dynamics.
        coverage: the transitions and the draws of actions; the others are not read.
        discount: gamma.
    """
    actions = jnp.asarray(coverage.actions)

    def shaping(transition: tuple[jax.Array, jax.Array]) -> jax.Array:
        here, following = (jnp.broadcast_to(x, (len(actions), x.size)) for x in transition)
        after_here = jax.vmap(successor)(here, actions)
        after_following = jax.vmap(successor)(following, actions)
        return jnp.mean(
            discount * reward(following, actions, after_following)
            - reward(here, actions, after_here)
            - discount * reward(after_here, actions, after_following)
        )

    made = jnp.asarray(coverage.observation), jnp.asarray(coverage.next_observation)
    given = reward(made[0], jnp.asarray(coverage.action), made[1])
    return given + jax.lax.map(shaping, made)


def pearson(canonical: Array, other: Array) -> jax.Array:
    """sqrt((1 - rho) / 2) of canonical forms `[..., N]`: between 0 and 1.

    A form without variance, that of a reward that prefers nothing, is unrelated to all others.
    """
    ours, theirs = (
        jnp.asarray(x) - jnp.mean(x, axis=-1, keepdims=True) for x in (canonical, other)
    )
    return _distance(ours, theirs)


def starc(dynamics: Dynamics, reward: jax.Array, discount: Numeric) -> jax.Array:
    """The value-adjusted canonical form of a reward `[..., S, A]` (Skalse et al. 2024).

    C(s, a) = R(s, a) - V(s) + gamma E[V(S')]

    with V the value of the policy that takes every action alike. Where a state is absorbing, a
    constant decides whether it is worth reaching, and is no equivalence.

    Args:
        dynamics: P(s'|s,a); an absorbing state leads to itself, and its rewards are 0.
        reward: the expected reward of each state and action.
        discount: gamma, below 1.
    """
    count = jnp.shape(reward)[-2]
    # Row s of the matrix: how the policy goes on from s.
    go_on = jax.vmap(
        lambda column: jnp.mean(dynamics_lib.expected_next(dynamics, column), axis=-1),
        out_axes=1,
    )(jnp.eye(count, dtype=jnp.result_type(reward)))
    paid = jnp.mean(reward, axis=-1)
    flat = paid.reshape(-1, count)
    values = jnp.linalg.solve(jnp.eye(count) - discount * go_on, flat.T).T

    def adjusted(reward: jax.Array, values: jax.Array) -> jax.Array:
        return reward - values[:, None] + discount * dynamics_lib.expected_next(dynamics, values)

    forms = jax.vmap(adjusted)(jnp.reshape(reward, (-1, *jnp.shape(reward)[-2:])), values)
    return forms.reshape(jnp.shape(reward))


def normalised(canonical: Array, other: Array, counted: Array | None = None) -> jax.Array:
    """Half the length of the difference of canonical forms `[..., S, A]`, each of length 1.

    A form of zeros, that of a reward that prefers nothing, is unrelated to all others.

    Args:
        canonical: a form.
        other: another one.
        counted: `[S]` bool, the states that count; default all.
    """
    count = jnp.shape(canonical)[-2]
    kept = jnp.ones(count, bool) if counted is None else jnp.asarray(counted)
    ours, theirs = (
        jnp.reshape(jnp.where(kept[:, None], x, 0.0), (*jnp.shape(x)[:-2], -1))
        for x in (canonical, other)
    )
    return _distance(ours, theirs)


def _distance(ours: jax.Array, theirs: jax.Array) -> jax.Array:
    """sqrt((1 - cos) / 2) of vectors `[..., N]`: half the distance of their directions."""
    lengths = jnp.linalg.norm(ours, axis=-1) * jnp.linalg.norm(theirs, axis=-1)
    cosine = jnp.sum(ours * theirs, axis=-1) / jnp.where(lengths > 0, lengths, 1.0)
    return jnp.sqrt(jnp.clip(1.0 - cosine, 0.0, 2.0) / 2.0)
