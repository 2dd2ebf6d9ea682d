"""Behaviour policies around a deterministic actor, each with its densities.

    behaviour = exploration.gaussian(env.spec, GaussianHParams(scale=0.3))
    action, log_density, state = behaviour.sample(key, state, agent.act(...), step)

The paper contradicts itself: Algorithm 2 adds a noise process, section 4.1 is epsilon-greedy. Both
are here.

An action has two densities. `perturb` returns the one to record: that of the action given the
state of the noise. `Exploration.log_density` is that of the action given the greedy action alone;
it can be asked of any policy about any action, and mixtures of policies are made of it.

Log densities are with respect to the base measure of `agents.densities`: Lebesgue measure inside
the action bounds and a unit mass at each bound of each dimension. Where a law has an atom elsewhere
its log density is inf.

A new exploration needs, all in this file: hyperparameters with a field in `ExplorationSettings`, a
factory, and an entry in `EXPLORATIONS`.
"""

import dataclasses
import functools
from typing import Annotated, Literal, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks, ranges
from cmedirl_jax.agents import behaviour, densities
from cmedirl_jax.agents.behaviour import Exploration, ExplorationKind
from cmedirl_jax.hyperparameters import traced
from cmedirl_jax.ranges import AtLeastOne, NotNegative, Positive, Range, Share
from cmedirl_jax.registries import Registry
from cmedirl_jax.types import EnvSpec, Numeric

ExplorationName = Annotated[
    Literal["ornstein-uhlenbeck", "gaussian", "epsilon-greedy"], ranges.Registered
]
"""The names in `EXPLORATIONS`."""


class GaussianHParams(flax.struct.PyTreeNode):
    """Independent Gaussian noise.

    Attributes:
        scale: Standard deviation, in half-widths of the action range.
    """

    scale: NotNegative = 0.5


class OrnsteinUhlenbeckHParams(flax.struct.PyTreeNode):
    """Ornstein-Uhlenbeck noise (Lillicrap et al. 2015), reset at each episode.

    Attributes:
        theta: Share of the noise that decays per environment step.
        sigma: Standard deviation of what each environment step adds to the noise, in half-widths
            of the action range.
    """

    theta: Annotated[float, Range(0.0, 2.0, "between 0 and 2")] = 0.15
    sigma: NotNegative = 0.5


class EpsilonGreedyHParams(flax.struct.PyTreeNode):
    """Epsilon-greedy with a linear schedule (the paper, section 4.1).

    Attributes:
        epsilon_start: Probability per environment step that a random action begins, at step 0.
        epsilon_end: Probability per environment step that a random action begins, from
            `epsilon_steps` on.
        epsilon_steps: Environment steps over which epsilon falls linearly.
        hold: Environment steps for which a random action is held (1: the paper's letter).
        noise: Standard deviation of Gaussian noise on mu(s), in half-widths of the action range;
            None: no noise, as in the paper.
    """

    epsilon_start: Share = 1.0
    epsilon_end: Share = 0.01
    epsilon_steps: AtLeastOne = 5000.0
    hold: AtLeastOne = 1.0
    # None has no leaf, so that whether there is noise is static.
    noise: Positive | None = None


@dataclasses.dataclass(frozen=True)
class ExplorationSettings:
    """The behaviour policy.

    Attributes:
        kind: Which exploration; the options of the others are ignored.
        hot_start_factor: Factor on the noise of a hot-started method: on sigma, on the scale, or on
            both epsilons.
        ornstein_uhlenbeck: Noise that is correlated over time.
        gaussian: Noise that is independent at each step.
        epsilon_greedy: Random actions now and then.
    """

    kind: ExplorationName = "ornstein-uhlenbeck"
    hot_start_factor: Positive = 1.0
    ornstein_uhlenbeck: OrnsteinUhlenbeckHParams = OrnsteinUhlenbeckHParams()
    gaussian: GaussianHParams = GaussianHParams()
    epsilon_greedy: EpsilonGreedyHParams = EpsilonGreedyHParams()


def make(
    spec: EnvSpec, settings: ExplorationSettings | None = None, *, hot_start: bool = False
) -> Exploration:
    """Make the behaviour policy that `settings.kind` names.

    Args:
        spec: the environment's sizes and bounds.
        settings: the kind, and its hyperparameters.
        hot_start: whether the actor is hot-started; its noise is multiplied by `hot_start_factor`.

    Raises:
        ValueError: for an unknown kind, a specification that contradicts itself, a hyperparameter
            out of range, or a factor that takes one out of its range.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    settings = settings or ExplorationSettings()
    kind = EXPLORATIONS[settings.kind]
    factor = settings.hot_start_factor if hot_start else 1.0
    return kind.make(spec, kind.scale(kind.hparams(settings), factor))


def check_density(settings: ExplorationSettings, *, trajectories: bool, mixture: bool) -> None:
    """Refuse weights for which the behaviour policy has no density; see `CheckDensityFn`.

    Raises:
        ValueError: naming the option that should be another; for an unknown kind.
    """
    kind = EXPLORATIONS[settings.kind]
    kind.check_density(kind.hparams(settings), trajectories=trajectories, mixture=mixture)


# Independent Gaussian noise.


def gaussian(spec: EnvSpec, hparams: GaussianHParams | None = None) -> Exploration:
    """clip(mu(s) + sigma eps) with eps ~ N(0, I). Its state is its hyperparameters.

    Raises:
        ValueError: if the specification contradicts itself, or a hyperparameter is out of range.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    initial = hparams or GaussianHParams()
    ranges.check(initial)
    return behaviour.assemble(
        spec,
        init=lambda key: traced(initial),
        reset=lambda state: state,
        draw=lambda key: jax.random.normal(key, (spec.action_dim,), jnp.float32),
        perturb=functools.partial(_perturb_gaussian, spec),
        log_density=functools.partial(_gaussian_log_density, spec),
    )


def _perturb_gaussian(
    spec: EnvSpec, state: GaussianHParams, action: jax.Array, noise: jax.Array, step: Numeric
) -> tuple[jax.Array, jax.Array, GaussianHParams]:
    noisy = _clip(spec, action + state.scale * _half_width(spec) * noise)
    return noisy, _gaussian_log_density(spec, state, action, noisy, step), state


def _gaussian_log_density(
    spec: EnvSpec, state: GaussianHParams, greedy: jax.Array, action: jax.Array, step: Numeric
) -> jax.Array:
    del step
    return densities.clipped_normal(spec, greedy, state.scale * _half_width(spec), action)


def _scale_gaussian(hparams: GaussianHParams, factor: Numeric) -> GaussianHParams:
    return hparams.replace(scale=factor * hparams.scale)


def _check_gaussian(hparams: GaussianHParams, *, trajectories: bool, mixture: bool) -> None:
    del trajectories, mixture
    if hparams.scale <= 0:
        raise ValueError("noise without a density: take exploration.gaussian.scale above 0")


# Ornstein-Uhlenbeck noise.


class OrnsteinUhlenbeckState(flax.struct.PyTreeNode):
    """The noise.

    Attributes:
        value: `[A]`, the noise last added, in units of the action.
        hparams: the hyperparameters.
    """

    value: jax.Array
    hparams: OrnsteinUhlenbeckHParams


def ornstein_uhlenbeck(
    spec: EnvSpec, hparams: OrnsteinUhlenbeckHParams | None = None
) -> Exploration:
    """clip(mu(s) + x_t), x_t = (1 - theta) x_{t-1} + sigma eps_t, x_0 = 0 at each episode.

    The recorded density is conditional on x_{t-1}. The one given mu(s) alone uses the stationary
    law of x, N(0, sigma^2 / (1 - (1 - theta)^2)), and needs 0 < theta < 2. It is an approximation:
    x is smaller at an episode's first steps, and later the state s depends on it.

    Raises:
        ValueError: if the specification contradicts itself, or a hyperparameter is out of range.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    initial = hparams or OrnsteinUhlenbeckHParams()
    ranges.check(initial)
    return behaviour.assemble(
        spec,
        init=lambda key: OrnsteinUhlenbeckState(
            jnp.zeros(spec.action_dim, jnp.float32), traced(initial)
        ),
        reset=lambda state: state.replace(value=jnp.zeros_like(state.value)),
        draw=lambda key: jax.random.normal(key, (spec.action_dim,), jnp.float32),
        perturb=functools.partial(_perturb_ornstein_uhlenbeck, spec),
        log_density=functools.partial(_ornstein_uhlenbeck_log_density, spec),
    )


def _perturb_ornstein_uhlenbeck(
    spec: EnvSpec, state: OrnsteinUhlenbeckState, action: jax.Array, noise: jax.Array, step: Numeric
) -> tuple[jax.Array, jax.Array, OrnsteinUhlenbeckState]:
    del step
    mean = (1.0 - state.hparams.theta) * state.value
    scale = state.hparams.sigma * _half_width(spec)
    noisy = _clip(spec, action + mean + scale * noise)
    log_density = densities.clipped_normal(spec, action + mean, scale, noisy)
    return noisy, log_density, state.replace(value=mean + scale * noise)


def _ornstein_uhlenbeck_log_density(
    spec: EnvSpec,
    state: OrnsteinUhlenbeckState,
    greedy: jax.Array,
    action: jax.Array,
    step: Numeric,
) -> jax.Array:
    del step
    theta, sigma = state.hparams.theta, state.hparams.sigma
    stationary = sigma * _half_width(spec) / jnp.sqrt(theta * (2.0 - theta))
    return densities.clipped_normal(spec, greedy, stationary, action)


def _scale_ornstein_uhlenbeck(
    hparams: OrnsteinUhlenbeckHParams, factor: Numeric
) -> OrnsteinUhlenbeckHParams:
    return hparams.replace(sigma=factor * hparams.sigma)


def _check_ornstein_uhlenbeck(
    hparams: OrnsteinUhlenbeckHParams, *, trajectories: bool, mixture: bool
) -> None:
    if hparams.sigma <= 0 or not 0 < hparams.theta < 2:
        raise ValueError(
            "noise without a density: take exploration.ornstein_uhlenbeck.sigma above 0 and theta "
            "between 0 and 2"
        )
    if trajectories and mixture:
        raise ValueError(
            "the noise of a trajectory is not known for another policy, whose density a mixture "
            "needs: take exploration.kind gaussian, or reward_batches.weights recorded"
        )


# Epsilon-greedy.


class HeldActionState(flax.struct.PyTreeNode):
    """The last action, and how long it is still held.

    Attributes:
        action: `[A]`, the last action, random or greedy.
        remaining: `[]`, environment steps for which it is held further.
        hparams: the hyperparameters.
    """

    action: jax.Array
    remaining: jax.Array
    hparams: EpsilonGreedyHParams


class _Noise(NamedTuple):
    """The randomness of a step: `[]` U(0, 1), a uniform action `[A]`, N(0, I) `[A]` or None."""

    choice: jax.Array
    action: jax.Array
    normal: jax.Array | None


def epsilon_greedy(spec: EnvSpec, hparams: EpsilonGreedyHParams | None = None) -> Exploration:
    """With probability epsilon a uniform random action, held for `hold` steps; else mu(s).

    `hparams.noise` adds clipped Gaussian noise to mu(s).

    The recorded density of an action that was just drawn is `densities.epsilon_greedy`: inf for
    mu(s) without noise. A held action is recorded with 1 / volume, the density of its draw. That is
    an approximation, since the state depends on an action that has been held for some steps. It
    gives no mass to the bounds, where noise has atoms. It must not be multiplied over a
    trajectory, in which a held action is drawn once.

    The density given mu(s) alone puts the random actions' share of the steps in the place of
    epsilon. It is exact for `hold` 1. For more it uses the share in the long run, and neglects the
    same dependence.

    Raises:
        ValueError: if the specification contradicts itself, or a hyperparameter is out of range.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    initial = hparams or EpsilonGreedyHParams()
    ranges.check(initial)
    return behaviour.assemble(
        spec,
        init=lambda key: HeldActionState(
            jnp.zeros(spec.action_dim, jnp.float32), jnp.zeros((), jnp.float32), traced(initial)
        ),
        reset=lambda state: state.replace(remaining=jnp.zeros_like(state.remaining)),
        draw=functools.partial(_draw_epsilon_greedy, spec, initial.noise is not None),
        perturb=functools.partial(_perturb_epsilon_greedy, spec),
        log_density=functools.partial(_epsilon_greedy_log_density, spec),
    )


def _draw_epsilon_greedy(spec: EnvSpec, noisy: bool, key: jax.Array) -> _Noise:
    keys = jax.random.split(key, 3 if noisy else 2)
    choice = jax.random.uniform(keys[0], dtype=jnp.float32)
    action = jax.random.uniform(
        keys[1], (spec.action_dim,), jnp.float32, minval=spec.action_low, maxval=spec.action_high
    )
    if not noisy:
        return _Noise(choice, action, None)
    # A float may fall on a bound, where it would be weighed as one of the noise's atoms.
    low, high = spec.action_low, spec.action_high
    margin = np.finfo(np.float32).eps * np.maximum(np.abs(low), np.abs(high))
    action = jnp.clip(action, low + margin, high - margin)
    return _Noise(choice, action, jax.random.normal(keys[2], (spec.action_dim,), jnp.float32))


def _perturb_epsilon_greedy(
    spec: EnvSpec, state: HeldActionState, action: jax.Array, noise: _Noise, step: Numeric
) -> tuple[jax.Array, jax.Array, HeldActionState]:
    # Hold the last action, begin a random one, or be greedy.
    choice, random_action, normal = noise
    epsilon, scale = _epsilon(state.hparams, step), _noise_scale(spec, state)
    noisy = action if scale is None or normal is None else _clip(spec, action + scale * normal)
    held = state.remaining > 0
    begins = ~held & (choice < epsilon)
    chosen = jnp.where(held, state.action, jnp.where(begins, random_action, noisy))

    log_density = jnp.where(
        held,
        -densities.log_volume(spec),
        densities.epsilon_greedy(spec, epsilon, action, chosen, scale),
    )
    remaining = jnp.where(begins, state.hparams.hold - 1.0, state.remaining - 1.0)
    last = chosen.astype(state.action.dtype)
    state = state.replace(action=last, remaining=jnp.maximum(remaining, 0.0))
    return chosen, log_density, state


def _epsilon_greedy_log_density(
    spec: EnvSpec, state: HeldActionState, greedy: jax.Array, action: jax.Array, step: Numeric
) -> jax.Array:
    epsilon, steps = _epsilon(state.hparams, step), jnp.ceil(state.hparams.hold)
    share = epsilon * steps / (1.0 + epsilon * (steps - 1.0))
    return densities.epsilon_greedy(spec, share, greedy, action, _noise_scale(spec, state))


def _epsilon(hparams: EpsilonGreedyHParams, step: Numeric) -> jax.Array:
    progress = jnp.clip(step / hparams.epsilon_steps, 0.0, 1.0)
    return hparams.epsilon_start + progress * (hparams.epsilon_end - hparams.epsilon_start)


def _noise_scale(spec: EnvSpec, state: HeldActionState) -> jax.Array | None:
    noise = state.hparams.noise
    return None if noise is None else noise * _half_width(spec)


def _scale_epsilon_greedy(hparams: EpsilonGreedyHParams, factor: Numeric) -> EpsilonGreedyHParams:
    start, end = factor * hparams.epsilon_start, factor * hparams.epsilon_end
    checks.shares(
        **{
            "exploration.epsilon_greedy.epsilon_start times hot_start_factor": start,
            "exploration.epsilon_greedy.epsilon_end times hot_start_factor": end,
        }
    )
    return hparams.replace(epsilon_start=start, epsilon_end=end)


def _check_epsilon_greedy(
    hparams: EpsilonGreedyHParams, *, trajectories: bool, mixture: bool
) -> None:
    if trajectories and hparams.hold > 1:
        raise ValueError(
            "a trajectory of held random actions has no density to weight it by: take "
            "reward_batches.weights uniform, or exploration.epsilon_greedy.hold 1"
        )
    if hparams.noise is None and (trajectories or mixture):
        raise ValueError(
            "a greedy action without noise has no density to weight it by: take "
            "reward_batches.weights uniform, or give exploration.epsilon_greedy.noise"
        )
    if hparams.noise is not None and hparams.noise <= 0:
        raise ValueError("take exploration.epsilon_greedy.noise above 0, or leave it out")


EXPLORATIONS: Registry[ExplorationKind] = Registry(
    "exploration",
    {
        "ornstein-uhlenbeck": ExplorationKind(
            make=ornstein_uhlenbeck,
            hparams=lambda settings: settings.ornstein_uhlenbeck,
            scale=_scale_ornstein_uhlenbeck,
            check_density=_check_ornstein_uhlenbeck,
        ),
        "gaussian": ExplorationKind(
            make=gaussian,
            hparams=lambda settings: settings.gaussian,
            scale=_scale_gaussian,
            check_density=_check_gaussian,
        ),
        "epsilon-greedy": ExplorationKind(
            make=epsilon_greedy,
            hparams=lambda settings: settings.epsilon_greedy,
            scale=_scale_epsilon_greedy,
            check_density=_check_epsilon_greedy,
        ),
    },
)
"""Maps each name to its exploration."""


def _half_width(spec: EnvSpec) -> jax.Array:
    return 0.5 * jnp.asarray(spec.action_high - spec.action_low)


def _clip(spec: EnvSpec, action: jax.Array) -> jax.Array:
    return jnp.clip(action, spec.action_low, spec.action_high)
