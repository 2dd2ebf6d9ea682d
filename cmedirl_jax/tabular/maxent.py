"""Maximum-entropy IRL with a model: linear (Ziebart et al. 2008), deep (Wulfmeier et al. 2015).

    demonstrations = tabular.empirical_visitation(state, action, mask, (S, A), discount=0.99)
    result = maxent_irl(dynamics, features, demonstrations, discount=0.99)
    result.reward, result.policy

The reward maximises L = log P(D | r) + log P(theta) (Eq. 4). The gradient of L is the difference in
visitation, mu_D - E[mu], passed back through the reward (Eqs. 6, 8 and 9), plus the gradient of the
Gaussian log prior (Eq. 5). For a reward of states alone, `[S]`, that difference is summed over the
actions, as in the paper.
"""

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks, modes, ranges
from cmedirl_jax.tabular import demonstrations as demonstrations_lib
from cmedirl_jax.tabular import dynamics as dynamics_lib
from cmedirl_jax.tabular import soft_control
from cmedirl_jax.tabular.demonstrations import TabularDemonstrations
from cmedirl_jax.tabular.dynamics import Dynamics
from cmedirl_jax.tabular.fixed_point import Stop
from cmedirl_jax.tabular.soft_control import SoftPolicy
from cmedirl_jax.types import Array, Network, Numeric, Params


class MaxEntInfo(NamedTuple):
    """Diagnostics of each step, of the parameters before it.

    Attributes:
        log_likelihood: `[steps]`, 1/N sum_i sum_t gamma^t log pi_t(a_t | s_t), never positive. It
            is what the fit maximises if the dynamics are deterministic, and otherwise in the limit
            of many demonstrations. With a horizon and without `demonstrations.steps`, it is that
            limit, (mu_D . r - sum_s D_0(s) V_0(s)) / alpha.
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
        info: diagnostics of every step.
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
    """Fit r = theta^T phi (Eq. 1) from theta = 0. L is concave in theta: any maximum is global.

    Demonstrations of different lengths need absorbing states: with a horizon alone, all have as
    many steps. Where the dynamics are random, a few demonstrations have visits that no policy has
    on average; there may then be no maximum without a prior, and theta grows from step to step.

    Args:
        dynamics: P(s'|s,a).
        features: phi, `[S, F]` for a reward of states or `[S, A, F]`.
        demonstrations: their visitation, at the same discount.
        discount: gamma, per step.
        horizon: steps of an episode; None: no limit.
        temperature: alpha of the soft-optimal policy.
        absorbing: `[S]` bool, the states in which an episode is over.
        prior_precision: lambda of the Gaussian prior on theta.
        optimizer: an optax optimiser, which descends the negative posterior. Default: L-BFGS with
            its line search.
        steps: steps of the optimiser.
        stop: when the fixed points' iterations end, if there is no horizon.

    Raises:
        ValueError: if the shapes do not fit each other, a size is not positive, a value that is
            not traced is out of range, or the demonstrations are not trajectories of the process
            (an early end where no absorbing state follows, an impossible transition).
        TypeError: for wrong dtypes.
    """
    features, size = jnp.asarray(features), jnp.shape(demonstrations.visitation)
    checks.kind("features", features, jnp.floating)
    checks.within(ranges.FINITE, features=features)
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
        key: randomness of the network's first parameters.
        network: `apply(params, *inputs)` gives `[S]` for a reward of states, or `[S, A]`.
        inputs: `(f [S, ...],)`, or `(f [S, A, ...], a [S, A, ...])`.
        dynamics: this and the rest as in `maxent_irl`; the default optimiser is Adam at 0.01.

    Raises:
        ValueError: as `maxent_irl`.
        TypeError: for wrong dtypes.
    """
    checks.sizes(steps=steps)
    checks.within(ranges.NOT_NEGATIVE, prior_precision=prior_precision)
    checks.within(ranges.FINITE, **{f"inputs[{i}]": array for i, array in enumerate(inputs)})
    visited, initial, _ = demonstrations
    dynamics_lib.check(dynamics, jnp.shape(visited), initial=initial, absorbing=absorbing)
    dynamics_lib.check_control(discount, horizon, temperature)
    demonstrations_lib.check(
        demonstrations, dynamics, discount=discount, horizon=horizon, absorbing=absorbing
    )
    precision = dynamics_lib.precision(dynamics, visited, initial, discount, temperature)
    visited, initial = jnp.asarray(visited, precision), jnp.asarray(initial, precision)
    problem = _Problem(
        network=network,
        inputs=inputs,
        dynamics=dynamics,
        demonstrations=demonstrations._replace(visitation=visited, initial=initial),
        temperature=temperature,
        prior_precision=prior_precision,
        control={"discount": discount, "horizon": horizon, "absorbing": absorbing, "stop": stop},
        optimizer=optax.with_extra_args_support(optimizer or optax.adam(0.01)),
    )

    # Each step's fixed points start where those of the step before ended.
    params = network.init(key)
    start = (params, problem.optimizer.init(params), jnp.zeros_like(initial), initial)
    step = functools.partial(_step, problem)
    start = modes.settle(lambda carry: step(carry, None)[0], start)
    (params, _, values, occupancy), info = jax.lax.scan(step, start, None, length=steps)
    reward = _reward(problem, params)
    policy = _soft_policy(problem, reward, values)
    return MaxEntResult(params, reward, policy, _visitation(problem, policy, occupancy), info)


class _Problem(NamedTuple):
    """What every step reads; the arguments of `deep_maxent_irl`.

    `control` holds the keyword arguments that both functions of `soft_control` take.
    """

    network: Network
    inputs: tuple[Array, ...]
    dynamics: Dynamics
    demonstrations: TabularDemonstrations
    temperature: Numeric
    prior_precision: Numeric
    control: dict[str, Any]
    optimizer: optax.GradientTransformationExtraArgs


def _step(
    problem: _Problem, carry: tuple[Any, optax.OptState, jax.Array, jax.Array], _: None
) -> tuple[tuple[Any, optax.OptState, jax.Array, jax.Array], MaxEntInfo]:
    """Take a step of the optimiser. The carry: theta, the optimiser's state, V and visits `[S]`."""
    # The policy that is optimal for the reward, and what it visits.
    params, state, values, occupancy = carry
    reward, backward = jax.vjp(functools.partial(_reward, problem), params)
    policy = _soft_policy(problem, reward, values)
    expected = _visitation(problem, policy, occupancy)

    # Eq. 9 with the sign of a loss: the difference in visitation is the error signal.
    difference = problem.demonstrations.visitation - expected
    (gradient,) = backward(-difference / problem.temperature)
    gradient = jax.tree.map(lambda g, theta: g + problem.prior_precision * theta, gradient, params)
    info = MaxEntInfo(
        _log_likelihood(problem, reward, policy),
        _log_prior(problem, params),
        jnp.sum(jnp.abs(difference)),
        policy.residual,
    )

    updates, state = problem.optimizer.update(
        gradient,
        state,
        params,
        # For optimisers that search along a line.
        value=-_objective(problem, reward, policy) - info.log_prior,
        grad=gradient,
        value_fn=functools.partial(_negative_posterior, problem, values),
    )
    params = optax.apply_updates(params, updates)
    if problem.control["horizon"] is None:
        values, occupancy = policy.values, jnp.sum(expected, axis=1)
    return (params, state, values, occupancy), info


def _reward(problem: _Problem, params: Params) -> jax.Array:
    """The network's reward of every pair, `[S, A]`."""
    visited = problem.demonstrations.visitation
    reward = problem.network.apply(params, *problem.inputs).astype(visited.dtype)
    size = visited.shape
    if reward.shape == size[:1]:
        reward = reward[:, None]
    elif reward.shape != size:
        raise ValueError(
            f"a reward of states is {size[:1]}, or of pairs {size}, got {reward.shape}"
        )
    return jnp.broadcast_to(reward, size)


def _soft_policy(problem: _Problem, reward: jax.Array, guess: jax.Array) -> SoftPolicy:
    return soft_control.soft_value_iteration(
        problem.dynamics, reward, temperature=problem.temperature, guess=guess, **problem.control
    )


def _visitation(problem: _Problem, policy: SoftPolicy, guess: jax.Array) -> jax.Array:
    initial = problem.demonstrations.initial
    return soft_control.expected_visitation(
        problem.dynamics, policy, initial, guess=guess, **problem.control
    )


def _objective(problem: _Problem, reward: jax.Array, policy: SoftPolicy) -> jax.Array:
    """(mu_D . r - sum_s D_0(s) V_0(s)) / alpha, whose gradient is Eq. 8."""
    visited, initial, _ = problem.demonstrations
    first = policy.values if problem.control["horizon"] is None else policy.values[0]
    return (jnp.sum(visited * reward) - initial @ first) / problem.temperature


def _log_likelihood(problem: _Problem, reward: jax.Array, policy: SoftPolicy) -> jax.Array:
    visited, _, steps = problem.demonstrations
    log_pi = policy.log_probabilities
    if problem.control["horizon"] is None:
        return jnp.sum(jnp.where(visited > 0, visited * log_pi, 0.0))
    if steps is None:
        return _objective(problem, reward, policy)
    time = jnp.arange(steps.mask.shape[1])
    discounts = jnp.asarray(problem.control["discount"], log_pi.dtype) ** time
    taken = discounts[None] * log_pi[time[None], steps.state, steps.action]
    return jnp.sum(jnp.where(steps.mask, taken, 0.0)) / steps.mask.shape[0]


def _log_prior(problem: _Problem, params: Params) -> jax.Array:
    return -0.5 * problem.prior_precision * optax.tree.norm(params, squared=True)


def _negative_posterior(problem: _Problem, guess: jax.Array, params: Params) -> jax.Array:
    """The loss `[]` at other parameters; `guess` is where the values' iteration begins."""
    reward = _reward(problem, params)
    policy = _soft_policy(problem, reward, guess)
    return -_objective(problem, reward, policy) - _log_prior(problem, params)
