"""Core types: what the parts of the library pass to each other. They have no behaviour."""

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

Params = Any
"""Parameters of a network: any pytree of arrays."""

Array = jax.Array | np.ndarray
"""An array on the device or on the host."""

Numeric = jax.Array | float
"""A scalar that may be traced: a Python number, or an array of shape `[]`."""


class EnvSpec(NamedTuple):
    """What an algorithm needs to know about an environment.

    `checks.env_spec` holds it to what is said here, wherever a specification is taken. Bounds are
    numpy arrays, not lists; float64 is read as float32 unless `jax_enable_x64` is set.

    Attributes:
        id: the environment's name, as Gymnasium writes it.
        observation_dim: `O`, the length of an observation vector.
        action_dim: `A`, the length of an action vector.
        observation_low: `[O]` float32, lower bounds of the observations; may be infinite.
        observation_high: `[O]` float32, upper bounds of the observations; may be infinite.
        action_low: `[A]` float32, lower bounds of the actions.
        action_high: `[A]` float32, upper bounds of the actions.
        max_episode_steps: environment steps after which an episode is truncated.
        reward_threshold: the mean return at which the task counts as solved; None where the task
            does not say.
    """

    id: str
    observation_dim: int
    action_dim: int
    observation_low: np.ndarray
    observation_high: np.ndarray
    action_low: np.ndarray
    action_high: np.ndarray
    max_episode_steps: int
    reward_threshold: float | None


class Transition(NamedTuple):
    """One step of experience, or a batch of them along any leading axes.

    Attributes:
        observation: `[..., O]` float32.
        action: `[..., A]` float32, inside the action bounds.
        reward: `[...]` float32, the environment's r_e (r* in a replay that stores it).
        next_observation: `[..., O]` float32, the true successor, also when the episode was
            truncated (never the first observation of the next episode).
        terminated: `[...]` bool; a time limit is not termination and still bootstraps.
    """

    observation: Any
    action: Any
    reward: Any
    next_observation: Any
    terminated: Any


class Demonstrations(NamedTuple):
    """A pool of `N` demonstrated steps, episode after episode.

    Attributes:
        transition: leaves `[N, ...]`, the environment's own rewards among them.
        truncated: `[N]` bool, the time limit cut the episode off at this step.
        episode: `[N]` int32, the number of the step's episode: 0, 0, ..., 1, 1, ...
        metadata: JSON values by name, among them `env`, the environment's name. It stays on the
            host: pass `pool.transition` and a subset to jitted functions, not the pool.
    """

    transition: Transition
    truncated: Array
    episode: Array
    metadata: dict[str, Any]


class DemonstrationSubset(NamedTuple):
    """Some episodes of a pool.

    Attributes:
        start: `[n]` int32, the pool's row in which each episode begins.
        length: `[n]` int32, steps of each episode; 0 is padding.
    """

    start: Array
    length: Array


class RewardBatch(NamedTuple):
    """What a reward is learned from: pairs or whole trajectories, with the densities they have.

    Attributes:
        transition: leaves `[B, ...]` for pairs, or `[M, T, ...]` for trajectories padded to T
            steps.
        log_density: for pairs `[B]`, log b(a|s) of each action under the law it was drawn from; for
            trajectories `[M]`, the sum of that over the steps, or the log of a mixture of such
            products. Zeros mean uniform weights; +inf leaves an entry out of the samples.
        mask: `[B]` or `[M, T]` bool, False past an episode's end. A trajectory without any True is
            left out.
    """

    transition: Transition
    log_density: Any
    mask: Any


class Network(NamedTuple):
    """A function approximator as two pure functions (three when it keeps running statistics).

    Attributes:
        init: `(key) -> params`.
        apply: `(params, *inputs) -> output`; inputs and output share their leading axes.
        train: `(params, *inputs) -> (output, params)` for a network whose parameters hold running
            statistics (batch normalisation): uses the batch's statistics and returns the parameters
            with the running ones moved. None for every other network.
    """

    init: Callable[[jax.Array], Params]
    apply: Callable[..., Any]
    train: Callable[..., tuple[Any, Params]] | None = None
