"""Resetting and stepping a vector environment of Gymnasium's, whatever its autoreset mode.

The callers reset sub-environments themselves, each by a seed of its own, so that an episode's start
depends on nothing else. What a vector environment has reset by itself is reset once more.
"""

from typing import Any

import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv

from cmedirl_jax.envs.base import Step


def reset(vector: VectorEnv, seeds: np.ndarray) -> np.ndarray:
    """Reset sub-environment i by `seeds[i]`; the first observations `[n, O]` float32."""
    return _reset(vector, seeds, None)


def restart(
    vector: VectorEnv, seeds: np.ndarray, ended: np.ndarray, observations: np.ndarray
) -> np.ndarray:
    """Reset the sub-environments that have `ended` `[n]` bool, and those alone.

    Args:
        vector: the sub-environments.
        seeds: `[n]`, of which those that ended take theirs.
        ended: which to reset.
        observations: `[n, O]`, of the others: what they observed last.

    Returns:
        `[n, O]` float32: the first observation of each new episode, elsewhere `observations`.

    Raises:
        ValueError: if the vector environment resets others too.
    """
    if not ended.any():
        return observations
    found = _reset(vector, seeds, {"reset_mask": ended})
    if not np.array_equal(found[~ended], observations[~ended], equal_nan=True):
        raise ValueError(f"{vector}: its reset does not know the option reset_mask")
    return found


def _reset(vector: VectorEnv, seeds: np.ndarray, options: dict[str, Any] | None) -> np.ndarray:
    # Its signature names one seed, its documentation a list too.
    observations, _ = vector.reset(seed=[int(seed) for seed in seeds], options=options)  # type: ignore[arg-type]
    return np.array(observations, np.float32)


def step(vector: VectorEnv, actions: np.ndarray) -> Step:
    """Step every sub-environment; none of them may have ended before.

    Args:
        vector: the sub-environments.
        actions: `[n, A]`, clipped to the bounds, which float32 may miss by a rounding; 0 for those
            of a learner that diverged, which may not break a simulator.

    Returns:
        The answers `[n, ...]`. The observation is the true successor, also of a sub-environment
        that the vector environment has reset in the same step.
    """
    space: Any = vector.action_space
    actions = np.clip(np.nan_to_num(actions).astype(space.dtype), space.low, space.high)
    observations, rewards, terminated, truncated, infos = vector.step(actions)
    return Step(
        successors(vector, observations, infos).astype(np.float32),
        np.asarray(rewards, np.float32),
        np.asarray(terminated, bool),
        np.asarray(truncated, bool),
    )


def successors(vector: VectorEnv, observations: Any, infos: dict[str, Any]) -> np.ndarray:
    """The true successors `[n, O]` of a step, also where the same step has reset."""
    found = np.array(observations)
    if vector.metadata.get("autoreset_mode") is AutoresetMode.SAME_STEP:
        for index in np.flatnonzero(infos.get("_final_obs", ())):
            found[index] = infos["final_obs"][index]
    return found
