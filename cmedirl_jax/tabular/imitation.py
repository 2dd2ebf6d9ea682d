"""Maximum-entropy IRL for a continuous task, by dynamic programming on a grid.

    mdp = imitation.discretised(env, settings)
    result = imitation.fit(key, mdp, env.spec, hot_start.data(pool), kind="linear")
    act = discretise.greedy(mdp, result.policy.action_values)

This is "the original Maximum Entropy IRL" that the paper compares with, and its deep form. Both
need a model, the environment's own dynamics on a grid, and never act in the environment.

The demonstrations followed other dynamics than the grid's. No reward therefore makes mu_D - E[mu]
zero, and the likelihood of Eq. 4 has no maximum: the prior and the number of steps limit the
reward's scale.
"""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
import optax

from cmedirl_jax import checks, ranges
from cmedirl_jax.data import demonstrations as demonstrations_lib
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.data.hot_start_data import HotStartData
from cmedirl_jax.envs import Env
from cmedirl_jax.irl import rewards
from cmedirl_jax.ranges import AtLeastTwo, BelowOne, NotNegative, Positive, Size
from cmedirl_jax.tabular import discretise, interpolation, maxent
from cmedirl_jax.tabular.demonstrations import TabularDemonstrations
from cmedirl_jax.tabular.discretise import FiniteMDP
from cmedirl_jax.tabular.interpolation import Grid
from cmedirl_jax.tabular.maxent import MaxEntResult
from cmedirl_jax.types import EnvSpec, Numeric

Kind = Literal["linear", "deep"]


@dataclasses.dataclass(frozen=True)
class TabularSettings:
    """The grid and the fit. All static.

    Attributes:
        states: Points along each dimension of the observation.
        actions: Points along each dimension of the action.
        subsamples: Transitions averaged for each state, along each dimension of the observation.
        discount: Discount of the soft-optimal policy and of both visitations, per environment step.
        temperature: Temperature alpha of the soft-optimal policy, in units of the reward.
        reward: r(s, a), or r(s).
        deviation: As r_D for an agent: its standard deviation over the states that demonstrations
            visit, in units of the environment's reward.
        prior_precision: Precision of the Gaussian prior on theta, against the log-likelihood of one
            demonstration.
        steps: Steps of Adam.
        centres: Radial basis functions along each dimension of the observation, for a linear
            reward.
        hidden: Units of each hidden layer, for a deep reward.
        linear_learning_rate: Adam's rate for a linear reward, per step.
        deep_learning_rate: Adam's rate for a deep reward, per step.
    """

    states: AtLeastTwo = 41
    actions: AtLeastTwo = 7
    subsamples: Size = 1
    discount: BelowOne = 0.99
    temperature: Positive = 1.0
    reward: rewards.Inputs = "state-action"
    deviation: Positive = 0.036
    prior_precision: NotNegative = 1e-3
    steps: Size = 100
    centres: AtLeastTwo = 9
    hidden: tuple[Size, ...] = (64, 64)
    linear_learning_rate: NotNegative = 0.3
    deep_learning_rate: NotNegative = 1e-2


def discretised(
    env: Env, settings: TabularSettings | None = None, *, params: Any = None
) -> FiniteMDP:
    """The environment on the settings' grid; `params` default to the environment's.

    Raises:
        ValueError: what `discretise.make` raises, or if a setting is out of range.
    """
    settings = settings or TabularSettings()
    ranges.check(settings)
    return discretise.make(
        env, *_shapes(env.spec, settings), params=params, subsamples=settings.subsamples
    )


def grids(spec: EnvSpec, settings: TabularSettings) -> tuple[Grid, Grid]:
    """The grids of the observations and of the actions."""
    return discretise.grids(spec, *_shapes(spec, settings))


def _shapes(spec: EnvSpec, settings: TabularSettings) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Points along each dimension of the observation, and of the action."""
    return (settings.states,) * spec.observation_dim, (settings.actions,) * spec.action_dim


def check(spec: EnvSpec, kind: Kind, settings: TabularSettings) -> None:
    """Check how much a reward holds of all states (and actions) of the grid, before it is made.

    Raises:
        ValueError: if that is above `checks.LARGEST_ARRAY`.
    """
    states, actions = _shapes(spec, settings)
    pairs, of_action = states, 1
    if settings.reward == "state-action":
        pairs, of_action = (*states, *actions), 1 + 2 * spec.action_dim
    if kind == "linear":
        features, what = (*[settings.centres] * spec.observation_dim, of_action), "centres"
    else:
        features, what = (max(settings.hidden, default=1),), "hidden units"
    checks.array_size(
        "the reward's features [S, A, F]",
        (*pairs, *features),
        f"take fewer states, actions or {what}",
    )


def fit(
    key: jax.Array,
    mdp: FiniteMDP,
    spec: EnvSpec,
    data: HotStartData,
    subset: DemonstrationSubset | None = None,
    *,
    kind: Kind,
    settings: TabularSettings | None = None,
) -> MaxEntResult:
    """Fit a linear (Ziebart et al. 2008) or deep (Wulfmeier et al. 2015) reward.

    Under `vmap` the seeds are fitted one after another. Gathering from many tables at once is four
    times as slow on a CPU, and no seed has to wait for another's fixed points.

    Args:
        key: randomness of a deep reward's first parameters.
        mdp: the environment on a grid; pass it through `jit` rather than close over it.
        spec: the environment's sizes and bounds.
        data: the pool of demonstrations.
        subset: which of them; default all.
        kind: "linear" or "deep".
        settings: every other choice.

    Raises:
        ValueError: as `visitation` and `check`, or if a setting is out of range.
    """
    settings = settings or TabularSettings()
    ranges.check(settings)
    check(spec, kind, settings)
    _check_subset(data, subset)
    fit_one = functools.partial(_fit, spec=spec, kind=kind, settings=settings)
    return jax.custom_batching.sequential_vmap(fit_one)(key, mdp, data, subset)


def _fit(
    key: jax.Array,
    mdp: FiniteMDP,
    data: HotStartData,
    subset: DemonstrationSubset | None,
    *,
    spec: EnvSpec,
    kind: Kind,
    settings: TabularSettings,
) -> MaxEntResult:
    demonstrations = visitation(mdp, data, subset, discount=settings.discount)
    # The barrier keeps the compiler from evaluating the rest as constants.
    inputs = jax.lax.optimization_barrier(jax.tree.map(jnp.asarray, _inputs(mdp, spec, settings)))
    linear = kind == "linear"
    rate = settings.linear_learning_rate if linear else settings.deep_learning_rate
    shared = {
        "discount": settings.discount,
        "temperature": settings.temperature,
        "absorbing": mdp.absorbing,
        "prior_precision": settings.prior_precision,
        "optimizer": optax.adam(rate),
        "steps": settings.steps,
    }
    if linear:
        features = rewards.radial_basis(spec, settings.centres, settings.reward)(*inputs)
        return maxent.maxent_irl(mdp.dynamics, features, demonstrations, **shared)
    network = rewards.mlp(spec, settings.hidden, settings.reward)
    return maxent.deep_maxent_irl(key, network, inputs, mdp.dynamics, demonstrations, **shared)


def _inputs(
    mdp: FiniteMDP, spec: EnvSpec, settings: TabularSettings
) -> tuple[np.ndarray, np.ndarray]:
    """Observations and actions of the reward: `[S, O]`, `[S, A]`, or of pairs `[S, P, ...]`."""
    states, actions = interpolation.points(mdp.states), interpolation.points(mdp.actions)
    # The absorbing state has no place on the grid. Its row's reward is never earned.
    observation = np.append(states, np.zeros_like(states[:1]), axis=0)
    if settings.reward == "state":
        return observation, np.zeros((len(observation), spec.action_dim), np.float32)
    pairs = (len(observation), len(actions))
    return (
        np.broadcast_to(observation[:, None], (*pairs, spec.observation_dim)),
        np.broadcast_to(actions, (*pairs, spec.action_dim)),
    )


def visitation(
    mdp: FiniteMDP,
    data: HotStartData,
    subset: DemonstrationSubset | None = None,
    *,
    discount: Numeric,
) -> TabularDemonstrations:
    """mu_D and D_0 of continuous demonstrations; each step is shared among neighbouring points.

    Args:
        mdp: the grids.
        data: the pool.
        subset: which of its demonstrations; default all.
        discount: gamma, per environment step.

    Raises:
        ValueError: if a known subset has no step, or an episode that the pool does not have, the
            discount is not between 0 and 1, or the visits `[N, 2^O, 2^A]` are above
            `checks.LARGEST_ARRAY`.
    """
    checks.shares(discount=discount)
    _check_subset(data, subset)
    corners = [2] * len(mdp.states.shape + mdp.actions.shape)
    checks.array_size(
        "the demonstrations' visits [N, 2^O, 2^A]",
        (*jnp.shape(data.transition.reward), *corners),
        "take fewer demonstrations",
    )
    pool = jax.tree.map(jnp.asarray, data.episodes)
    chosen = pool if subset is None else subset
    drawn = jnp.searchsorted(pool.start, chosen.start)
    there = (chosen.length > 0).astype(mdp.reward.dtype)
    weight = jnp.zeros(pool.start.shape, there.dtype).at[drawn].add(there / jnp.sum(there))
    # Rows of the pool outside its `episodes` weigh nothing.
    row = jnp.arange(data.transition.reward.shape[0])
    episode = jnp.maximum(jnp.searchsorted(pool.start, row, side="right") - 1, 0)
    time = row - pool.start[episode]
    inside = (time >= 0) & (time < pool.length[episode])
    weight = jnp.where(inside, weight[episode], 0.0)
    # A discount to a large negative power would be infinite.
    time = jnp.where(inside, time, 0)
    state, state_weight = interpolation.interpolate(mdp.states, data.transition.observation)
    action, action_weight = interpolation.interpolate(mdp.actions, data.transition.action)
    discounts = jnp.asarray(discount**time, weight.dtype)
    visits = (weight * discounts)[:, None] * state_weight  # [N, 2^O]
    both = visits[:, :, None] * action_weight[:, None, :]
    starts = jnp.where(time == 0, weight, 0.0)[:, None] * state_weight
    empty = jnp.zeros_like(mdp.reward)
    return TabularDemonstrations(
        empty.at[state[:, :, None], action[:, None, :]].add(both),
        empty[:, 0].at[state].add(starts),
    )


def _check_subset(data: HotStartData, subset: DemonstrationSubset | None) -> None:
    if subset is None:
        return
    demonstrations_lib.check_subset(subset)
    if all(map(ranges.known, (*subset, *data.episodes))):
        pool = set(zip(*(np.asarray(field).tolist() for field in data.episodes), strict=True))
        for start, length in zip(*(np.asarray(field).tolist() for field in subset), strict=True):
            if length and (start, length) not in pool:
                raise ValueError(
                    f"subset: the pool has no episode of {length} steps from step {start}"
                )
