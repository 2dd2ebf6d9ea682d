"""The interface of behaviour policies, and the checks of what they are given."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import jax
import jax.numpy as jnp

from cmedirl_jax import checks, modes
from cmedirl_jax.types import EnvSpec, Numeric


class PerturbFn(Protocol):
    """Turn a greedy action into the behaviour policy's."""

    def __call__(
        self, state: Any, action: jax.Array, noise: Any, step: Numeric
    ) -> tuple[jax.Array, jax.Array, Any]:
        """Return `(action [A], log_density [], state)`.

        Args:
            state: the exploration's.
            action: `[A]`, the greedy action mu(s).
            noise: what `draw` gave.
            step: `[]`, environment steps taken so far.

        Raises:
            ValueError: if the action, the noise or the step has another shape.
            TypeError: if the action or the noise is not of floats.
        """
        ...


class LogDensityFn(Protocol):
    """Log density of the behaviour policy's action, given the greedy action alone."""

    def __call__(
        self, state: Any, greedy: jax.Array, action: jax.Array, step: Numeric
    ) -> jax.Array:
        """Return the log density `[...]` of `action` `[..., A]` where mu(s) is `greedy` `[..., A]`.

        Leading axes are broadcast. Of `state` it reads the hyperparameters alone.

        Raises:
            ValueError: for another last axis, or leading axes that cannot be broadcast.
            TypeError: for arrays that are not of floats.
        """
        ...


class Exploration(NamedTuple):
    """A behaviour policy as pure functions.

    Attributes:
        init: `(key) -> state`, at the start of a run.
        reset: `(state) -> state`, at the start of an episode.
        sample: `(key, state, action, step) -> (action, log_density, state)`, `perturb` with noise
            that is drawn from `key`. `log_density` `[]` is log b(a|s), given the noise's state.
        draw: `(key) -> noise`, the randomness of `sample`, to draw ahead of time.
        perturb: see `PerturbFn`.
        log_density: see `LogDensityFn`.
    """

    init: Callable[[jax.Array], Any]
    reset: Callable[[Any], Any]
    sample: Callable[..., tuple[jax.Array, jax.Array, Any]]
    draw: Callable[[jax.Array], Any]
    perturb: PerturbFn
    log_density: LogDensityFn


class CheckDensityFn(Protocol):
    """Refuse importance weights for which the behaviour policy has no density."""

    def __call__(self, hparams: Any, *, trajectories: bool, mixture: bool) -> None:
        """Check the hyperparameters, where r_D is learned with 1 / density as weights.

        Args:
            hparams: the exploration's own.
            trajectories: whether whole trajectories are weighed, not single pairs.
            mixture: whether the density is that of a mixture of policies, not the one recorded.

        Raises:
            ValueError: naming the option that should be another.
        """
        ...


class ExplorationKind(NamedTuple):
    """All that belongs to the name of an exploration.

    Attributes:
        make: `(spec, hparams) -> Exploration`.
        hparams: `(settings) -> hparams`, its own field of `ExplorationSettings`.
        scale: `(hparams, factor) -> hparams` with `factor` times the noise.
        check_density: see `CheckDensityFn`.
    """

    make: Callable[[EnvSpec, Any], Exploration]
    hparams: Callable[[Any], Any]
    scale: Callable[[Any, Numeric], Any]
    check_density: CheckDensityFn


def assemble(
    spec: EnvSpec,
    *,
    init: Callable[[jax.Array], Any],
    reset: Callable[[Any], Any],
    draw: Callable[[jax.Array], Any],
    perturb: PerturbFn,
    log_density: LogDensityFn,
) -> Exploration:
    """Make an exploration of its functions, and check the arrays that reach them.

    Raises:
        ValueError: if the specification contradicts itself.
        TypeError: if a size or a bound of the specification has a wrong type.
    """
    checks.env_spec(spec)
    shapes = jax.tree.map(jnp.shape, jax.eval_shape(lambda: draw(jax.random.key(0))))
    checked_perturb = functools.partial(_perturb, spec, shapes, perturb)
    return Exploration(
        init=functools.partial(_init, init),
        reset=reset,
        sample=functools.partial(_sample, draw, checked_perturb),
        draw=draw,
        perturb=checked_perturb,
        log_density=functools.partial(_log_density, spec, log_density),
    )


def _init(init: Callable[[jax.Array], Any], key: jax.Array) -> Any:
    return modes.vary(init(key), key)


def _sample(
    draw: Callable[[jax.Array], Any],
    perturb: PerturbFn,
    key: jax.Array,
    state: Any,
    action: jax.Array,
    step: Numeric,
) -> tuple[jax.Array, jax.Array, Any]:
    return perturb(state, action, draw(key), step)


def _perturb(
    spec: EnvSpec,
    shapes: Any,
    perturb: PerturbFn,
    state: Any,
    action: jax.Array,
    noise: Any,
    step: Numeric,
) -> tuple[jax.Array, jax.Array, Any]:
    checks.shape("action", action, (spec.action_dim,))
    checks.kind("action", action, jnp.floating)
    noise_shapes = jax.tree.map(jnp.shape, noise)
    if noise_shapes != shapes:
        raise ValueError(f"noise: expected shape {shapes}, got {noise_shapes}")
    for leaf in jax.tree.leaves(noise):
        checks.kind("noise", leaf, jnp.floating)
    checks.shape("step", step, ())
    return perturb(state, action, noise, step)


def _log_density(
    spec: EnvSpec,
    log_density: LogDensityFn,
    state: Any,
    greedy: jax.Array,
    action: jax.Array,
    step: Numeric,
) -> jax.Array:
    checks.vectors("greedy", greedy, spec.action_dim)
    checks.vectors("action", action, spec.action_dim)
    jnp.broadcast_shapes(jnp.shape(greedy), jnp.shape(action))
    return log_density(state, greedy, action, step)
