"""Tasks that are not written in JAX: Gymnasium's, stepped on the host.

task = envs.from_gymnasium("InvertedPendulum-v5")
result = training.host.fit(key, task, "ddpg", seeds=8, steps=10_000)
"""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from cmedirl_jax import checks
from cmedirl_jax.types import EnvSpec


class HostEnv(NamedTuple):
    """A task that is stepped on the host.

    Attributes:
        spec: the sizes and bounds.
        vector: `(count) -> gymnasium.vector.VectorEnv` of so many sub-environments, in any
            autoreset mode. Its `reset` knows the option `reset_mask`, as those of Gymnasium do.
    """

    spec: EnvSpec
    vector: Callable[[int], VectorEnv]


def from_gymnasium(
    id: str | Callable[..., gymnasium.Env],
    *,
    asynchronous: bool = False,
    wrappers: Sequence[Callable[[gymnasium.Env], gymnasium.Env]] = (),
    max_episode_steps: int | None = None,
    reward_threshold: float | None = None,
    **kwargs: Any,
) -> HostEnv:
    """Make a task of Gymnasium one that this library trains on.

    Args:
        id: a name that `gymnasium.make` knows, `"module:Name-v0"` too; or what makes the task.
        asynchronous: step every sub-environment in a process of its own, which pays off where a
            step takes longer than some 0.1 ms.
        wrappers: what each sub-environment is wrapped in, one after the other.
        max_episode_steps: steps after which an episode is truncated; default the task's own.
        reward_threshold: the mean return that counts as solved; default the task's own, if any.
        **kwargs: of `gymnasium.make`, or of what makes the task.

    Raises:
        ValueError: for a space that is no box of one axis, actions without bounds, or a task
            without a time limit, saying what is possible.
        gymnasium.error.Error: if Gymnasium does not know the name, or something that the task needs
            is not installed.
    """
    make = functools.partial(gymnasium.make, id) if isinstance(id, str) else id
    make_one = functools.partial(_make, make, tuple(wrappers), max_episode_steps, kwargs)
    env = make_one()
    try:
        name = id if isinstance(id, str) else None
        spec = _spec(name, env, max_episode_steps, reward_threshold)
    finally:
        env.close()
    return HostEnv(spec, functools.partial(_vector, make_one, asynchronous))


def _make(
    make: Callable[..., gymnasium.Env],
    wrappers: tuple[Callable[[gymnasium.Env], gymnasium.Env], ...],
    max_episode_steps: int | None,
    kwargs: dict[str, Any],
) -> gymnasium.Env:
    """One sub-environment; the given time limit is the outermost but the wrappers'."""
    env = make(**kwargs)
    if max_episode_steps is not None:
        env = gymnasium.wrappers.TimeLimit(env, max_episode_steps)
    for wrapper in wrappers:
        env = wrapper(env)
    return env


def _vector(make_one: Callable[[], gymnasium.Env], asynchronous: bool, count: int) -> VectorEnv:
    checks.sizes(count=count)
    makers = [make_one] * count
    if not asynchronous:
        return SyncVectorEnv(makers, autoreset_mode=AutoresetMode.DISABLED)
    # JAX has started threads, which a forked process would not have.
    return AsyncVectorEnv(makers, context="forkserver", autoreset_mode=AutoresetMode.DISABLED)


def _spec(
    name: str | None,
    env: gymnasium.Env,
    max_episode_steps: int | None,
    reward_threshold: float | None,
) -> EnvSpec:
    known = env.spec
    name = name or (known.id if known else type(env.unwrapped).__name__)
    if isinstance(env.action_space, gymnasium.spaces.Discrete):
        raise ValueError(f"{name}: its actions are {env.action_space}; DDPG's are continuous")
    observation_low, observation_high = _bounds(name, "observations", env.observation_space)
    action_low, action_high = _bounds(name, "actions", env.action_space)
    if not (np.isfinite(action_low) & np.isfinite(action_high)).all():
        raise ValueError(
            f"{name}: its actions have no bounds; give wrappers that bound them, as "
            "gymnasium.wrappers.RescaleAction"
        )
    if max_episode_steps is None and known is not None:
        max_episode_steps = known.max_episode_steps
    if max_episode_steps is None:
        raise ValueError(
            f"{name}: it has no time limit; give max_episode_steps, here or when you register it"
        )
    if reward_threshold is None and known is not None:
        reward_threshold = known.reward_threshold
    spec = EnvSpec(
        id=name,
        observation_dim=len(observation_low),
        action_dim=len(action_low),
        observation_low=observation_low,
        observation_high=observation_high,
        action_low=action_low,
        action_high=action_high,
        max_episode_steps=max_episode_steps,
        reward_threshold=reward_threshold,
    )
    checks.env_spec(spec)
    return spec


def _bounds(name: str, what: str, space: gymnasium.Space) -> tuple[np.ndarray, np.ndarray]:
    if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
        found = f"of shape {space.shape}" if isinstance(space, gymnasium.spaces.Box) else space
        remedy = ", as gymnasium.wrappers.FlattenObservation does" * (what == "observations")
        raise ValueError(
            f"{name}: its {what} are {found}, not a Box of one axis; give wrappers that make them "
            f"one{remedy}"
        )
    # float64 has bounds that float32 does not reach.
    with np.errstate(over="ignore"):
        return space.low.astype(np.float32), space.high.astype(np.float32)
