"""The interface of reward learners: their state, their diagnostics, their functions."""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import flax.struct
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import checks
from cmedirl_jax.types import EnvSpec, Params, RewardBatch, Transition


class RewardInfo(NamedTuple):
    """Diagnostics of one update, all `[]`, of the state before it.

    Attributes:
        demonstration_reward: mean r_D over the demonstration batch.
        background_reward: mean r_D over the background batch, without appended demonstrations.
        log_likelihood: the data term of the objective, up to a constant.
        log_prior: log P(theta), up to a constant.
        gradient_norm: global norm of the gradient that the optimiser was given.
        effective_sample_size: (sum w)^2 / sum w^2 of the samples' weights w.
    """

    demonstration_reward: jax.Array
    background_reward: jax.Array
    log_likelihood: jax.Array
    log_prior: jax.Array
    gradient_norm: jax.Array
    effective_sample_size: jax.Array


class RewardState(flax.struct.PyTreeNode):
    """A learned reward.

    Attributes:
        params: parameters of r_D.
        optimizer: state of the optimiser.
        hparams: the learner's hyperparameters, numbers as `[]` float32.
    """

    params: Params
    optimizer: optax.OptState
    hparams: Any


class UpdateFn(Protocol):
    """One iteration of Algorithm 1, lines 4-6."""

    def __call__(
        self,
        state: RewardState,
        demonstrations: Transition | RewardBatch,
        background: Transition | RewardBatch,
        *,
        key: jax.Array | None = None,
    ) -> tuple[RewardState, RewardInfo]:
        """Take a gradient step.

        Args:
            state: the state before.
            demonstrations: the demonstration batch, leaves `[D, ...]`, or trajectories.
            background: the background batch, leaves `[B, ...]`, or trajectories.
            key: randomness, for learners that draw.

        Raises:
            ValueError: if a batch has other shapes than the learner takes, or `key` is missing.
            TypeError: if a leaf is not of floats, or `terminated` or the mask is not bool.
        """
        ...


class RewardLearner(NamedTuple):
    """A learner of rewards as pure functions.

    Attributes:
        init: `(key) -> RewardState`.
        reward: `(state, observation [..., O], action [..., A]) -> [...]`, r_D(s, a; theta). That of
            a network raises ValueError for wrong shapes and TypeError for wrong dtypes, while
            tracing.
        update: see `UpdateFn`.
        absorbing: `(state) -> []`, r_D of the absorbing state that follows termination; None if
            there is no such state.
    """

    init: Callable[[jax.Array], RewardState]
    reward: Callable[[RewardState, jax.Array, jax.Array], jax.Array]
    update: UpdateFn
    absorbing: Callable[[RewardState], jax.Array] | None = None


def learn_nothing(
    state: RewardState,
    demonstrations: Transition | RewardBatch,
    background: Transition | RewardBatch,
    *,
    key: jax.Array | None = None,
) -> tuple[RewardState, RewardInfo]:
    """The update of a reward that does not learn."""
    del demonstrations, background, key
    return state, no_info()


def no_info() -> RewardInfo:
    """The diagnostics of a step without an update: zeros."""
    return RewardInfo(*(jnp.zeros((), jnp.float32) for _ in RewardInfo._fields))


def pairs(spec: EnvSpec, batch: Transition | RewardBatch, name: str) -> RewardBatch:
    """Check a batch of pairs. A `Transition` becomes a `RewardBatch` of uniform weights.

    Raises:
        ValueError: if its shapes are not `[B, O]`, `[B, A]` and `[B]`.
        TypeError: if a leaf is not of floats, or `terminated` or the mask is not bool.
    """
    return _checked(spec, batch, name, ("B",))


def trajectories(spec: EnvSpec, batch: Transition | RewardBatch, name: str) -> RewardBatch:
    """Check a batch of trajectories. A `Transition` becomes a `RewardBatch` of uniform weights.

    Raises:
        ValueError: if its shapes are not `[M, T, O]`, `[M, T, A]`, `[M, T]` and `[M]`.
        TypeError: if a leaf is not of floats, or `terminated` or the mask is not bool.
    """
    return _checked(spec, batch, name, ("M", "T"))


def _checked(
    spec: EnvSpec, batch: Transition | RewardBatch, name: str, axes: tuple[str, ...]
) -> RewardBatch:
    transition = batch.transition if isinstance(batch, RewardBatch) else batch
    leading = jnp.shape(transition.observation)[: len(axes)]
    if not isinstance(batch, RewardBatch):
        batch = RewardBatch(
            transition, jnp.zeros(leading[:1], jnp.float32), jnp.ones(leading, bool)
        )
    expected = [
        ("observations", transition.observation, (*leading, spec.observation_dim)),
        ("actions", transition.action, (*leading, spec.action_dim)),
        ("terminated", transition.terminated, leading),
        ("log densities", batch.log_density, leading[:1]),
        ("mask", batch.mask, leading),
    ]
    for what, leaf, shape in expected:
        if len(leading) < len(axes) or jnp.shape(leaf) != shape:
            sizes = {"observations": [spec.observation_dim], "actions": [spec.action_dim]}
            wanted = [*axes[: 1 if what == "log densities" else None], *sizes.get(what, [])]
            raise ValueError(
                f"{name}: expected {what} [{', '.join(map(str, wanted))}] beside observations "
                f"{jnp.shape(transition.observation)}, got {jnp.shape(leaf)}"
            )
        logical = what in ("terminated", "mask")
        checks.kind(f"{name}: {what}", leaf, jnp.bool_ if logical else jnp.floating)
    return batch
