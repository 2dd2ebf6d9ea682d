"""Maximum-entropy IRL with a model: linear (Ziebart et al. 2008), deep (Wulfmeier et al. 2015).

    demonstrations = empirical_visitation(state, action, mask, (S, A), discount=0.99)
    found = maxent_irl(dynamics, features, demonstrations, discount=0.99)
    found.reward, found.policy

The reward maximises L = log P(D | r) + log P(theta) (Eq. 4). Its gradient is the difference in
visitation, mu_D - E[mu], passed back through the reward (Eqs. 6, 8 and 9), plus that of the
Gaussian log prior (Eq. 5). A reward of states alone, `[S]`, sees that difference summed over the
actions, as the paper writes it.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks
from cmedirl_jax.tabular import dynamics as dynamics_lib
from cmedirl_jax.tabular import soft_control
from cmedirl_jax.tabular.dynamics import Dynamics
from cmedirl_jax.tabular.fixed_point import Stop
from cmedirl_jax.tabular.soft_control import SoftPolicy
from cmedirl_jax.types import Array, Network, Numeric, Params


class TabularDemonstrations(NamedTuple):
    """What maximum-entropy IRL reads of the demonstrations.

    Attributes:
        visitation: `[S, A]`, mu_D(s, a) = 1/N sum_i sum_t gamma^t 1[(s_t, a_t) = (s, a)].
        initial: `[S]`, the distribution of their first states.
    """

    visitation: jax.Array
    initial: jax.Array


class MaxEntInfo(NamedTuple):
    """Diagnostics of each step, before it.

    Attributes:
        log_likelihood: `[steps]`, (mu_D . r - sum_s D_0(s) V_0(s)) / alpha: the demonstrations'
            discounted causal log-likelihood where the dynamics are deterministic, else its
            expectation over the dynamics.
        log_prior: `[steps]`, -(lambda / 2) ||theta||^2.
        visitation_error: `[steps]`, sum_{s,a} |mu_D - E[mu]|.
        residual: `[steps]`, see `SoftPolicy`.
    """

    log_likelihood: jax.Array
    log_prior: jax.Array
    visitation_error: jax.Array
    residual: jax.Array


class MaxEntResult(NamedTuple):
    """A reward and its soft-optimal policy.

    Attributes:
        params: theta; `[F]` for linear features.
        reward: `[S, A]`.
        policy: soft-optimal for that reward.
        visitation: `[S, A]`, E[mu] of that policy.
        info: of every step.
    """

    params: Params
    reward: jax.Array
    policy: SoftPolicy
    visitation: jax.Array
    info: MaxEntInfo


def maxent_irl(
    dynamics: Dynamics,
    features: Array,
    demonstrations: TabularDemonstrations,
    *,
    discount: Numeric,
    horizon: int | None = None,
    temperature: Numeric = 1.0,
    absorbing: Array | None = None,
    prior_precision: Numeric = 0.0,
    optimizer: optax.GradientTransformation | None = None,
    steps: int = 50,
    stop: Stop | None = None,
) -> MaxEntResult:
    """Fit r = theta^T phi (Eq. 1) from theta = 0. Concave in theta: any optimum is the optimum.

    Args:
        dynamics: P(s'|s,a).
        features: phi, `[S, F]` for a reward of states or `[S, A, F]`.
        demonstrations: their visitation, at the same discount.
        discount: gamma.
        horizon: steps of an episode, or None.
        temperature: alpha of the soft-optimal policy.
        absorbing: `[S]` bool, where the episode is over.
        prior_precision: lambda of the Gaussian prior on theta.
        optimizer: any optax one; it descends the negative posterior. Default L-BFGS, which
            searches along lines.
        steps: of the optimiser.
        stop: of the fixed points, without a horizon.

    Raises:
        ValueError: if the shapes do not fit each other, or a size is not positive.
        TypeError: for other dtypes.
    """
    features, size = jnp.asarray(features), jnp.shape(demonstrations.visitation)
    checks.kind("features", features, jnp.floating)
    if features.ndim < 2 or features.shape[:-1] not in (size[:1], size):
        raise ValueError(
            f"expected features [S, F] or [S, A, F] beside a visitation {size}, "
            f"got {features.shape}"
        )
    linear = Network(
        init=lambda key: jnp.zeros(features.shape[-1], features.dtype),
        apply=lambda theta, features: features @ theta,
    )
    return deep_maxent_irl(
        jax.random.key(0),  # Nothing is drawn.
        linear,
        (features,),
        dynamics,
        demonstrations,
        discount=discount,
        horizon=horizon,
        temperature=temperature,
        absorbing=absorbing,
        prior_precision=prior_precision,
        optimizer=optimizer or optax.lbfgs(),
        steps=steps,
        stop=stop,
    )


def deep_maxent_irl(
    key: jax.Array,
    network: Network,
    inputs: tuple[Array, ...],
    dynamics: Dynamics,
    demonstrations: TabularDemonstrations,
    *,
    discount: Numeric,
    horizon: int | None = None,
    temperature: Numeric = 1.0,
    absorbing: Array | None = None,
    prior_precision: Numeric = 0.0,
    optimizer: optax.GradientTransformation | None = None,
    steps: int = 200,
    stop: Stop | None = None,
) -> MaxEntResult:
    """Fit r = g(f, theta), a network of every state (and action).

    Args:
        key: of the network's first parameters.
        network: `apply(params, *inputs)` gives `[S]` for a reward of states, or `[S, A]`.
        inputs: `(f [S, ...],)`, or `(f [S, A, ...], a [S, A, ...])`.
        dynamics: and all that follows as in `maxent_irl`; the default optimiser is Adam at 0.01.

    Raises:
        ValueError: if the shapes do not fit each other, or a size is not positive.
        TypeError: for other dtypes.
    """
    checks.sizes(steps=steps)
    tx = optax.with_extra_args_support(optimizer or optax.adam(0.01))
    visited, initial = demonstrations
    dynamics_lib.check(dynamics, jnp.shape(visited), initial=initial, absorbing=absorbing)
    checks.kind("visitation", visited, jnp.floating)
    shared = {
        "discount": discount,
        "horizon": horizon,
        "absorbing": absorbing,
        "stop": stop,
    }

    def of_pairs(params: Params) -> jax.Array:
        reward = network.apply(params, *inputs)
        if reward.shape == visited.shape[:1]:
            reward = reward[:, None]
        elif reward.shape != visited.shape:
            raise ValueError(
                f"a reward of states is {visited.shape[:1]}, or of pairs {visited.shape}, "
                f"got {reward.shape}"
            )
        return jnp.broadcast_to(reward, visited.shape)

    def solve(reward: jax.Array, guess: jax.Array) -> SoftPolicy:
        return soft_control.soft_value_iteration(
            dynamics, reward, temperature=temperature, guess=guess, **shared
        )

    def log_likelihood(reward: jax.Array, policy: SoftPolicy) -> jax.Array:
        first = policy.values if horizon is None else policy.values[0]
        return (jnp.sum(visited * reward) - initial @ first) / temperature

    def log_prior(params: Params) -> jax.Array:
        return -0.5 * prior_precision * optax.tree.norm(params, squared=True)

    def visits(policy: SoftPolicy, guess: jax.Array) -> jax.Array:
        return soft_control.expected_visitation(dynamics, policy, initial, guess=guess, **shared)

    def step(carry, _: None):
        params, state, values, occupancy = carry
        reward, backward = jax.vjp(of_pairs, params)
        policy = solve(reward, values)
        expected = visits(policy, occupancy)
        difference = visited - expected
        # Eq. 9 with a loss's sign: the difference in visitation is the error signal.
        (gradient,) = backward(-difference / temperature)
        gradient = jax.tree.map(lambda g, theta: g + prior_precision * theta, gradient, params)

        def loss(params: Params) -> jax.Array:
            reward = of_pairs(params)
            return -log_likelihood(reward, solve(reward, values)) - log_prior(params)

        info = MaxEntInfo(
            log_likelihood(reward, policy),
            log_prior(params),
            jnp.sum(jnp.abs(difference)),
            policy.residual,
        )
        updates, state = tx.update(
            gradient,
            state,
            params,
            # For those that search along a line.
            value=-info.log_likelihood - info.log_prior,
            grad=gradient,
            value_fn=loss,
        )
        params = optax.apply_updates(params, updates)
        if horizon is None:
            values, occupancy = policy.values, jnp.sum(expected, axis=1)
        return (params, state, values, occupancy), info

    # Fixed points are looked for where the last ones were found.
    params = network.init(key)
    start = (params, tx.init(params), jnp.zeros_like(initial), initial)
    (params, _, values, occupancy), info = jax.lax.scan(step, start, None, length=steps)
    reward = of_pairs(params)
    policy = solve(reward, values)
    return MaxEntResult(params, reward, policy, visits(policy, occupancy), info)


def empirical_visitation(
    state: Array, action: Array, mask: Array, size: tuple[int, int], *, discount: Numeric
) -> TabularDemonstrations:
    """Count demonstrations: mu_D and D_0.

    Without a horizon they have to end in absorbing states: one that is cut off after T steps adds
    an error of the order of gamma^T to the gradient.

    Args:
        state: `[N, T]` int.
        action: `[N, T]` int.
        mask: `[N, T]` bool, False past a demonstration's end; its first step is never past it.
        size: (S, A).
        discount: gamma.
    """
    mask = jnp.asarray(mask)
    weight = mask * jnp.asarray(discount) ** jnp.arange(mask.shape[1]) / mask.shape[0]
    return TabularDemonstrations(
        jnp.zeros(size, weight.dtype).at[state, action].add(weight),
        jnp.zeros(size[0], weight.dtype).at[jnp.asarray(state)[:, 0]].add(1.0 / mask.shape[0]),
    )
