"""Behaviour policies around a deterministic actor, each with its density.

The paper contradicts itself: Algorithm 2 adds a noise process, section 4.1 is epsilon-greedy. Both
are here. Every `log_density` is with respect to one base measure: Lebesgue measure inside the
action bounds, plus a unit mass at each bound of each dimension where clipping puts one, plus (for
the epsilon-greedy kind) a unit mass at the greedy action mu(s) and at an action being held.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp

from cmedirl_jax.types import EnvSpec, Numeric


class PerturbFn(Protocol):
    """Turn a greedy action into the behaviour policy's."""

    def __call__(
        self, state: Any, action: jax.Array, noise: Any, step: Numeric
    ) -> tuple[jax.Array, jax.Array, Any]:
        """Return `(action [A], log_density [], state)`; `step` counts environment steps."""
        ...


class Exploration(NamedTuple):
    """A behaviour policy as pure functions.

    Attributes:
        init: `(key) -> state`, at the start of a run.
        reset: `(state) -> state`, at the start of an episode.
        sample: `(key, state, action, step) -> (action, log_density, state)`; `action` `[A]` in is
            mu(s), out is what the behaviour policy does; `log_density` `[]` is its log b(a|s).
        draw: `(key) -> noise`, the randomness of `sample`, to draw ahead of time.
        perturb: see `PerturbFn`; `sample` is `perturb` of `draw`.
    """

    init: Callable[[jax.Array], Any]
    reset: Callable[[Any], Any]
    sample: Callable[..., tuple[jax.Array, jax.Array, Any]]
    draw: Callable[[jax.Array], Any]
    perturb: PerturbFn


class GaussianHParams(flax.struct.PyTreeNode):
    """Independent Gaussian noise."""

    scale: float = 0.5
    """Standard deviation, in half-widths of the action range."""


class OrnsteinUhlenbeckHParams(flax.struct.PyTreeNode):
    """Ornstein-Uhlenbeck noise (Lillicrap et al. 2015), reset at each episode."""

    theta: float = 0.15
    """Share of the noise that decays per step."""
    sigma: float = 0.5
    """Standard deviation of the innovation, in half-widths of the action range."""


class EpsilonGreedyHParams(flax.struct.PyTreeNode):
    """Epsilon-greedy with a linear schedule (the paper, section 4.1)."""

    epsilon_start: float = 1.0
    """Probability that a random action begins, at step 0."""
    epsilon_end: float = 0.01
    """Probability that a random action begins, from `epsilon_steps` on."""
    epsilon_steps: float = 5000.0
    """Environment steps over which epsilon falls linearly."""
    hold: float = 1.0
    """Steps for which a random action is held (1: the paper's letter)."""


class OrnsteinUhlenbeckState(flax.struct.PyTreeNode):
    """`value` `[A]`, the noise last added, and the hyperparameters."""

    value: jax.Array
    hparams: OrnsteinUhlenbeckHParams


class HeldActionState(flax.struct.PyTreeNode):
    """`action` `[A]` is held for `remaining` more steps."""

    action: jax.Array
    remaining: jax.Array
    hparams: EpsilonGreedyHParams


def gaussian(spec: EnvSpec, hparams: GaussianHParams | None = None) -> Exploration:
    """clip(mu(s) + sigma eps) with eps ~ N(0, I); its state is its hyperparameters."""
    hparams = hparams or GaussianHParams()

    def perturb(state: GaussianHParams, action: jax.Array, noise: jax.Array, step: Numeric):
        del step
        scale = state.scale * _half_width(spec)
        action, log_density = _clipped_normal(spec, action, scale, noise)
        return action, log_density, state

    return _exploration(
        init=lambda key: _traced(hparams),
        reset=lambda state: state,
        draw=lambda key: jax.random.normal(key, (spec.action_dim,)),
        perturb=perturb,
    )


def ornstein_uhlenbeck(
    spec: EnvSpec, hparams: OrnsteinUhlenbeckHParams | None = None
) -> Exploration:
    """clip(mu(s) + x_t), x_t = (1 - theta) x_{t-1} + sigma eps_t, x_0 = 0 at each episode.

    The density is conditional on x_{t-1}.
    """
    hparams = hparams or OrnsteinUhlenbeckHParams()

    def init(key: jax.Array) -> OrnsteinUhlenbeckState:
        del key
        return OrnsteinUhlenbeckState(jnp.zeros(spec.action_dim), _traced(hparams))

    def perturb(state: OrnsteinUhlenbeckState, action: jax.Array, noise: jax.Array, step: Numeric):
        del step
        mean = (1.0 - state.hparams.theta) * state.value
        scale = state.hparams.sigma * _half_width(spec)
        noisy, log_density = _clipped_normal(spec, action + mean, scale, noise)
        return noisy, log_density, state.replace(value=mean + scale * noise)

    return _exploration(
        init=init,
        reset=lambda state: state.replace(value=jnp.zeros_like(state.value)),
        draw=lambda key: jax.random.normal(key, (spec.action_dim,)),
        perturb=perturb,
    )


def epsilon_greedy(spec: EnvSpec, hparams: EpsilonGreedyHParams | None = None) -> Exploration:
    """With probability epsilon a uniform random action, held for `hold` steps; else mu(s).

    The density is conditional on the state: epsilon / volume where a random action begins, 1 (a
    mass) while it is held, 1 - epsilon (a mass at mu(s)) where the action is greedy. So the
    densities of a trajectory's steps multiply to the trajectory's.
    """
    hparams = hparams or EpsilonGreedyHParams()
    log_volume = float(jnp.sum(jnp.log(2.0 * _half_width(spec))))

    def init(key: jax.Array) -> HeldActionState:
        del key
        return HeldActionState(jnp.zeros(spec.action_dim), jnp.zeros(()), _traced(hparams))

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array]:
        choice_key, action_key = jax.random.split(key)
        random_action = jax.random.uniform(
            action_key, (spec.action_dim,), minval=spec.action_low, maxval=spec.action_high
        )
        return jax.random.uniform(choice_key), random_action

    def perturb(
        state: HeldActionState,
        action: jax.Array,
        noise: tuple[jax.Array, jax.Array],
        step: Numeric,
    ):
        choice, random_action = noise
        epsilon = _epsilon(state.hparams, step)
        held = state.remaining > 0
        begins = ~held & (choice < epsilon)
        chosen = jnp.where(held, state.action, jnp.where(begins, random_action, action))
        log_density = jnp.where(
            held,
            0.0,
            jnp.where(begins, jnp.log(epsilon) - log_volume, jnp.log1p(-epsilon)),
        )
        remaining = jnp.where(begins, state.hparams.hold - 1.0, state.remaining - 1.0)
        state = state.replace(action=chosen, remaining=jnp.maximum(remaining, 0.0))
        return chosen, log_density, state

    return _exploration(
        init=init,
        reset=lambda state: state.replace(remaining=jnp.zeros_like(state.remaining)),
        draw=draw,
        perturb=perturb,
    )


def _epsilon(hparams: EpsilonGreedyHParams, step: Numeric) -> jax.Array:
    progress = jnp.clip(step / hparams.epsilon_steps, 0.0, 1.0)
    return hparams.epsilon_start + progress * (hparams.epsilon_end - hparams.epsilon_start)


def _traced(hparams: Any) -> Any:
    """Hyperparameters as float32 arrays, so that a state has one type whoever made it."""
    return jax.tree.map(lambda leaf: jnp.asarray(leaf, jnp.float32), hparams)


def _half_width(spec: EnvSpec) -> jax.Array:
    return 0.5 * jnp.asarray(spec.action_high - spec.action_low)


def _clipped_normal(
    spec: EnvSpec, mean: jax.Array, scale: jax.Array, noise: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """clip(mean + scale * noise) `[A]` and its log density `[]`, tail masses at the bounds."""
    low, high = jnp.asarray(spec.action_low), jnp.asarray(spec.action_high)
    action = jnp.clip(mean + scale * noise, low, high)
    inside = -0.5 * jnp.square((action - mean) / scale) - jnp.log(scale * math.sqrt(2 * math.pi))
    at_low = jax.scipy.stats.norm.logcdf((low - mean) / scale)
    at_high = jax.scipy.stats.norm.logcdf((mean - high) / scale)
    log_density = jnp.where(action <= low, at_low, jnp.where(action >= high, at_high, inside))
    return action, jnp.sum(log_density, axis=-1)


def _exploration(
    init: Callable[[jax.Array], Any],
    reset: Callable[[Any], Any],
    draw: Callable[[jax.Array], Any],
    perturb: PerturbFn,
) -> Exploration:
    def sample(key: jax.Array, state: Any, action: jax.Array, step: Numeric):
        return perturb(state, action, draw(key), step)

    return Exploration(init, reset, sample, draw, perturb)
