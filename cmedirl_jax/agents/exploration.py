"""Behaviour policies around a deterministic actor, each with its densities.

The paper contradicts itself: Algorithm 2 adds a noise process, section 4.1 is epsilon-greedy. Both
are here. Every log density is with respect to the base measure of `irl.densities`: Lebesgue measure
inside the action bounds and a unit mass at each bound of each dimension. An action that the law has
an atom at elsewhere has log density inf.

Two densities belong to an action: the one that `perturb` returns when it is taken, given the
noise's state, and `Exploration.log_density`, of the state's greedy action alone, which can be asked
of any policy about any action and is what mixtures of policies are made of.
"""

import dataclasses
from collections.abc import Callable
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import checks
from cmedirl_jax.agents import densities
from cmedirl_jax.optimizers import traced
from cmedirl_jax.ranges import AtLeastOne, NotNegative, Positive, Range, Share
from cmedirl_jax.registries import Registry
from cmedirl_jax.types import EnvSpec, Numeric

ExplorationName = Literal["ornstein-uhlenbeck", "gaussian", "epsilon-greedy"]
"""The names in `EXPLORATIONS`."""


class PerturbFn(Protocol):
    """Turn a greedy action into the behaviour policy's."""

    def __call__(
        self, state: Any, action: jax.Array, noise: Any, step: Numeric
    ) -> tuple[jax.Array, jax.Array, Any]:
        """Return `(action [A], log_density [], state)`; `step` `[]` counts environment steps.

        Raises:
            ValueError: if the action, the noise or the step is of another shape.
            TypeError: if the action or the noise is not of floats.
        """
        ...


class Exploration(NamedTuple):
    """A behaviour policy as pure functions.

    Attributes:
        init: `(key) -> state`, at the start of a run.
        reset: `(state) -> state`, at the start of an episode.
        sample: `(key, state, action, step) -> (action, log_density, state)`; `action` `[A]` in is
            mu(s), out is what the behaviour policy does; `log_density` `[]` is its log b(a|s),
            given the noise's state. It raises what `perturb` does.
        draw: `(key) -> noise`, the randomness of `sample`, to draw ahead of time.
        perturb: see `PerturbFn`; `sample` is `perturb` of `draw`.
        log_density: `(state, greedy [..., A], action [..., A], step) -> [...]`, the log density of
            the marginal law of the action where mu(s) is `greedy`; of `state` it reads the
            hyperparameters alone. Leading axes are broadcast. ValueError for another last axis or
            leading axes that do not go together, TypeError for what is not floats.
    """

    init: Callable[[jax.Array], Any]
    reset: Callable[[Any], Any]
    sample: Callable[..., tuple[jax.Array, jax.Array, Any]]
    draw: Callable[[jax.Array], Any]
    perturb: PerturbFn
    log_density: Callable[[Any, jax.Array, jax.Array, Numeric], jax.Array]


class GaussianHParams(flax.struct.PyTreeNode):
    """Independent Gaussian noise.

    Attributes:
        scale: Standard deviation, in half-widths of the action range.
    """

    scale: NotNegative = 0.5


class OrnsteinUhlenbeckHParams(flax.struct.PyTreeNode):
    """Ornstein-Uhlenbeck noise (Lillicrap et al. 2015), reset at each episode.

    Attributes:
        theta: Share of the noise that decays per step.
        sigma: Standard deviation of the innovation, in half-widths of the action range.
    """

    theta: Annotated[float, Range(0.0, 2.0, "between 0 and 2")] = 0.15
    sigma: NotNegative = 0.5


class EpsilonGreedyHParams(flax.struct.PyTreeNode):
    """Epsilon-greedy with a linear schedule (the paper, section 4.1).

    Attributes:
        epsilon_start: Probability that a random action begins, at step 0.
        epsilon_end: Probability that a random action begins, from `epsilon_steps` on.
        epsilon_steps: Environment steps over which epsilon falls linearly.
        hold: Steps for which a random action is held (1: the paper's letter).
        noise: Standard deviation of Gaussian noise on mu(s), in half-widths of the action range.
            None for none, as in the paper; that is static, a number is not.
    """

    epsilon_start: Share = 1.0
    epsilon_end: Share = 0.01
    epsilon_steps: AtLeastOne = 5000.0
    hold: AtLeastOne = 1.0
    noise: Positive | None = None


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
        noisy = _clip(spec, action + state.scale * _half_width(spec) * noise)
        return noisy, log_density(state, action, noisy, step), state

    def log_density(state: GaussianHParams, greedy: jax.Array, action: jax.Array, step: Numeric):
        del step
        return densities.clipped_normal(spec, greedy, state.scale * _half_width(spec), action)

    return _exploration(
        spec,
        init=lambda key: traced(hparams),
        reset=lambda state: state,
        draw=lambda key: jax.random.normal(key, (spec.action_dim,)),
        perturb=perturb,
        log_density=log_density,
    )


def ornstein_uhlenbeck(
    spec: EnvSpec, hparams: OrnsteinUhlenbeckHParams | None = None
) -> Exploration:
    """clip(mu(s) + x_t), x_t = (1 - theta) x_{t-1} + sigma eps_t, x_0 = 0 at each episode.

    The density recorded is conditional on x_{t-1}. The marginal one is of x's stationary law,
    N(0, sigma^2 / (1 - (1 - theta)^2)), which is an approximation: at an episode's first steps x is
    smaller, and later the state s that it led to says something about it. It needs 0 < theta < 2.
    """
    hparams = hparams or OrnsteinUhlenbeckHParams()

    def init(key: jax.Array) -> OrnsteinUhlenbeckState:
        del key
        return OrnsteinUhlenbeckState(jnp.zeros(spec.action_dim), traced(hparams))

    def perturb(state: OrnsteinUhlenbeckState, action: jax.Array, noise: jax.Array, step: Numeric):
        del step
        mean = (1.0 - state.hparams.theta) * state.value
        scale = state.hparams.sigma * _half_width(spec)
        noisy = _clip(spec, action + mean + scale * noise)
        log_density = densities.clipped_normal(spec, action + mean, scale, noisy)
        return noisy, log_density, state.replace(value=mean + scale * noise)

    def log_density(
        state: OrnsteinUhlenbeckState, greedy: jax.Array, action: jax.Array, step: Numeric
    ):
        del step
        theta, sigma = state.hparams.theta, state.hparams.sigma
        stationary = sigma * _half_width(spec) / jnp.sqrt(theta * (2.0 - theta))
        return densities.clipped_normal(spec, greedy, stationary, action)

    return _exploration(
        spec,
        init=init,
        reset=lambda state: state.replace(value=jnp.zeros_like(state.value)),
        draw=lambda key: jax.random.normal(key, (spec.action_dim,)),
        perturb=perturb,
        log_density=log_density,
    )


def epsilon_greedy(spec: EnvSpec, hparams: EpsilonGreedyHParams | None = None) -> Exploration:
    """With probability epsilon a uniform random action, held for `hold` steps; else mu(s).

    Whether mu(s) is taken as it is or with clipped Gaussian noise is `hparams.noise`. The density
    recorded of an action just drawn is `densities.epsilon_greedy`: inf for mu(s) without noise. Of
    a held action it is 1 / volume, its own draw's, given that one is held: that the state has come
    of it is neglected, bounds where noise has atoms are out of its reach, and these densities do
    not multiply to a trajectory's, to which a held action adds a factor of one.

    The marginal density has the random actions' share of the steps in the place of epsilon. It is
    exact for `hold` 1; for more it neglects the same and is of the share in the long run.
    """
    hparams = hparams or EpsilonGreedyHParams()

    def init(key: jax.Array) -> HeldActionState:
        del key
        return HeldActionState(jnp.zeros(spec.action_dim), jnp.zeros(()), traced(hparams))

    def draw(key: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array | None]:
        keys = jax.random.split(key, 2 if hparams.noise is None else 3)
        choice = jax.random.uniform(keys[0])
        random_action = jax.random.uniform(
            keys[1], (spec.action_dim,), minval=spec.action_low, maxval=spec.action_high
        )
        if hparams.noise is None:
            return choice, random_action, None
        # A float may fall on a bound, where it would be weighed as one of the noise's atoms.
        low, high = spec.action_low, spec.action_high
        margin = np.finfo(np.float32).eps * np.maximum(np.abs(low), np.abs(high))
        random_action = jnp.clip(random_action, low + margin, high - margin)
        return choice, random_action, jax.random.normal(keys[2], (spec.action_dim,))

    def perturb(
        state: HeldActionState,
        action: jax.Array,
        noise: tuple[jax.Array, jax.Array, Any],
        step: Numeric,
    ):
        choice, random_action, normal = noise
        epsilon, scale = _epsilon(state.hparams, step), noise_scale(state)
        noisy = action if scale is None else _clip(spec, action + scale * normal)
        held = state.remaining > 0
        begins = ~held & (choice < epsilon)
        chosen = jnp.where(held, state.action, jnp.where(begins, random_action, noisy))
        log_density = jnp.where(
            held,
            -densities.log_volume(spec),
            densities.epsilon_greedy(spec, epsilon, action, chosen, scale),
        )
        remaining = jnp.where(begins, state.hparams.hold - 1.0, state.remaining - 1.0)
        state = state.replace(action=chosen, remaining=jnp.maximum(remaining, 0.0))
        return chosen, log_density, state

    def log_density(state: HeldActionState, greedy: jax.Array, action: jax.Array, step: Numeric):
        epsilon, steps = _epsilon(state.hparams, step), jnp.ceil(state.hparams.hold)
        share = epsilon * steps / (1.0 + epsilon * (steps - 1.0))
        return densities.epsilon_greedy(spec, share, greedy, action, noise_scale(state))

    def noise_scale(state: HeldActionState) -> jax.Array | None:
        noise = state.hparams.noise
        return None if noise is None else noise * _half_width(spec)

    return _exploration(
        spec,
        init=init,
        reset=lambda state: state.replace(remaining=jnp.zeros_like(state.remaining)),
        draw=draw,
        perturb=perturb,
        log_density=log_density,
    )


def _epsilon(hparams: EpsilonGreedyHParams, step: Numeric) -> jax.Array:
    progress = jnp.clip(step / hparams.epsilon_steps, 0.0, 1.0)
    return hparams.epsilon_start + progress * (hparams.epsilon_end - hparams.epsilon_start)


def _half_width(spec: EnvSpec) -> jax.Array:
    return 0.5 * jnp.asarray(spec.action_high - spec.action_low)


def _clip(spec: EnvSpec, action: jax.Array) -> jax.Array:
    return jnp.clip(action, spec.action_low, spec.action_high)


def _exploration(
    spec: EnvSpec,
    init: Callable[[jax.Array], Any],
    reset: Callable[[Any], Any],
    draw: Callable[[jax.Array], Any],
    perturb: PerturbFn,
    log_density: Callable[[Any, jax.Array, jax.Array, Numeric], jax.Array],
) -> Exploration:
    """Put the pieces together, and checks of the arrays before them."""
    drawn = jax.tree.map(jnp.shape, jax.eval_shape(lambda: draw(jax.random.key(0))))

    def checked_perturb(state: Any, action: jax.Array, noise: Any, step: Numeric):
        checks.shape("action", action, (spec.action_dim,))
        checks.kind("action", action, jnp.floating)
        found = jax.tree.map(jnp.shape, noise)
        if found != drawn:
            raise ValueError(f"noise: expected shape {drawn}, got {found}")
        for leaf in jax.tree.leaves(noise):
            checks.kind("noise", leaf, jnp.floating)
        checks.shape("step", step, ())
        return perturb(state, action, noise, step)

    def checked_log_density(
        state: Any, greedy: jax.Array, action: jax.Array, step: Numeric
    ) -> jax.Array:
        checks.vectors("greedy", greedy, spec.action_dim)
        checks.vectors("action", action, spec.action_dim)
        jnp.broadcast_shapes(jnp.shape(greedy), jnp.shape(action))
        return log_density(state, greedy, action, step)

    def sample(key: jax.Array, state: Any, action: jax.Array, step: Numeric):
        return checked_perturb(state, action, draw(key), step)

    return Exploration(init, reset, sample, draw, checked_perturb, checked_log_density)


@dataclasses.dataclass(frozen=True)
class ExplorationSettings:
    """The behaviour policy.

    Attributes:
        kind: Which noise; the options of the others are ignored.
        hot_start_factor: Factor on the noise of a hot-started method: on sigma, on the scale, or on
            both epsilons.
    """

    kind: ExplorationName = "ornstein-uhlenbeck"
    hot_start_factor: Positive = 1.0
    ornstein_uhlenbeck: OrnsteinUhlenbeckHParams = OrnsteinUhlenbeckHParams()
    gaussian: GaussianHParams = GaussianHParams()
    epsilon_greedy: EpsilonGreedyHParams = EpsilonGreedyHParams()


class CheckDensityFn(Protocol):
    """Refuse importance weights for which the behaviour policy has no density."""

    def __call__(self, hparams: Any, *, trajectories: bool, mixture: bool) -> None:
        """Check the hyperparameters, where r_D is learned with 1 / density as weights.

        Args:
            hparams: the exploration's own.
            trajectories: whole trajectories are weighed, not single pairs.
            mixture: the density is that of a mixture of policies, not the one recorded.

        Raises:
            ValueError: naming the option that should be another.
        """
        ...


class ExplorationKind(NamedTuple):
    """All that belongs to the name of an exploration.

    Attributes:
        make: `(spec, hparams) -> Exploration`.
        hparams: `(settings) -> hparams`, its own of the settings'.
        scale: `(hparams, factor) -> hparams` with `factor` times the noise.
        check_density: see `CheckDensityFn`.
    """

    make: Callable[[EnvSpec, Any], Exploration]
    hparams: Callable[[ExplorationSettings], Any]
    scale: Callable[[Any, Numeric], Any]
    check_density: CheckDensityFn


def make(
    spec: EnvSpec, settings: ExplorationSettings | None = None, *, hot_start: bool = False
) -> Exploration:
    """The behaviour policy that `settings.kind` names.

    Args:
        spec: the environment's sizes and bounds.
        settings: the kind, and its hyperparameters.
        hot_start: whether the actor is hot-started: then the noise is that of the settings times
            `hot_start_factor`.

    Raises:
        ValueError: for an unknown kind.
    """
    settings = settings or ExplorationSettings()
    kind = EXPLORATIONS[settings.kind]
    factor = settings.hot_start_factor if hot_start else 1.0
    return kind.make(spec, kind.scale(kind.hparams(settings), factor))


def check_density(settings: ExplorationSettings, *, trajectories: bool, mixture: bool) -> None:
    """Refuse weights for which the behaviour policy has no density, see `CheckDensityFn`."""
    kind = EXPLORATIONS[settings.kind]
    kind.check_density(kind.hparams(settings), trajectories=trajectories, mixture=mixture)


def _scale_gaussian(hparams: GaussianHParams, factor: Numeric) -> GaussianHParams:
    return hparams.replace(scale=factor * hparams.scale)


def _check_gaussian(hparams: GaussianHParams, *, trajectories: bool, mixture: bool) -> None:
    del trajectories, mixture
    if hparams.scale <= 0:
        raise ValueError("noise without a density: take exploration.gaussian.scale above 0")


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
            "what noise another policy would have needed at the step before is not known: take "
            "exploration.kind gaussian, or reward_batches.weights recorded"
        )


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
