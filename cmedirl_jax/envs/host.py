"""Tasks that are not written in JAX: Gymnasium's, stepped on the host.

task = envs.from_gymnasium("InvertedPendulum-v5")
result = training.host.fit(key, task, "ddpg", seeds=8, steps=10_000)
"""

import functools
import multiprocessing
import os
import signal
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv

from cmedirl_jax import checks
from cmedirl_jax.envs.base import Bounds, spec_of
from cmedirl_jax.types import EnvSpec


class HostEnv(NamedTuple):
    """A task that is stepped on the host.

    Attributes:
        spec: the sizes and bounds.
        vector: `(count) -> gymnasium.vector.VectorEnv` of so many sub-environments, in any
            autoreset mode. Its `reset` knows the option `reset_mask`, as those of Gymnasium do.
            The `vector` of `from_gymnasium` raises ValueError if the count is not positive,
            TypeError if it is not an integer.
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
    """Make a task of Gymnasium one that this library trains on. It is made and stepped once.

    Args:
        id: a name that `gymnasium.make` knows, `"module:Name-v0"` too; or what makes the task.
        asynchronous: step every sub-environment in a process of its own. A program that does so
            needs `if __name__ == "__main__":`, as every one that starts processes.
        wrappers: what each sub-environment is wrapped in, one after the other.
        max_episode_steps: steps after which an episode is truncated; default the task's own.
        reward_threshold: the mean return that counts as solved; default the task's own, if any.
        **kwargs: of `gymnasium.make`, or of what makes the task.

    Raises:
        ValueError: if Gymnasium does not know the name, or the task cannot be made; for a space
            that is no box of one axis or whose low is not below its high, actions that are no
            floats or have no bounds, a task without a time limit, or one whose observations or
            rewards are not what its spaces say.
    """
    name = id if isinstance(id, str) else getattr(id, "__name__", type(id).__name__)
    make_one = functools.partial(_make, id, tuple(wrappers), max_episode_steps, kwargs)
    try:
        env = make_one()
    except gymnasium.error.UnregisteredEnv as error:
        raise ValueError(f"unknown environment {name!r}; Gymnasium says: {error}") from error
    except Exception as error:
        # Making somebody's task may raise anything.
        reason = " ".join(f"{type(error).__name__}: {error}".split())
        raise ValueError(f"{name} cannot be made ({reason})") from error
    try:
        if not isinstance(id, str):
            name = env.spec.id if env.spec else type(env.unwrapped).__name__
        spec = _spec(name, env, max_episode_steps, reward_threshold)
        _try(env, spec)
    finally:
        env.close()
    return HostEnv(spec, functools.partial(_vector, make_one, asynchronous))


class _Bare(gymnasium.Wrapper):
    """Without infos, which nobody reads and vectors cannot stack; no options are None, not {}."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return self.env.reset(seed=seed, options=options or None)[0], {}

    def step(self, action: Any) -> Any:
        *answer, _ = self.env.step(action)
        return *answer, {}


def _make(
    id: str | Callable[..., gymnasium.Env],
    wrappers: tuple[Callable[[gymnasium.Env], gymnasium.Env], ...],
    max_episode_steps: int | None,
    kwargs: dict[str, Any],
) -> gymnasium.Env:
    """One sub-environment."""
    if isinstance(id, str):
        env = gymnasium.make(id, max_episode_steps=max_episode_steps, **kwargs)
    else:
        env = id(**kwargs)
        limit = env.spec.max_episode_steps if env.spec else None
        if max_episode_steps is not None:
            if limit is not None and limit < max_episode_steps:
                raise ValueError(f"it ends after {limit} steps, before max_episode_steps")
            env = gymnasium.wrappers.TimeLimit(env, max_episode_steps)
    for wrapper in wrappers:
        env = wrapper(env)
    return _Bare(env)


def _vector(make_one: Callable[[], gymnasium.Env], asynchronous: bool, count: int) -> VectorEnv:
    checks.sizes(count=count)
    if not asynchronous:
        return SyncVectorEnv([make_one] * count, autoreset_mode=AutoresetMode.DISABLED)
    # JAX has started threads, which a forked process would not have. What is imported once in the
    # server is shared by all that it forks.
    multiprocessing.set_forkserver_preload([__name__])
    makers = [functools.partial(_in_worker, os.getpid(), make_one)] * count
    return AsyncVectorEnv(makers, context="forkserver", autoreset_mode=AutoresetMode.DISABLED)


def _in_worker(parent: int, make_one: Callable[[], gymnasium.Env]) -> gymnasium.Env:
    """One sub-environment; a worker leaves the terminal's interrupts to its parent."""
    if os.getpid() != parent:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    return make_one()


def _spec(
    name: str, env: gymnasium.Env, max_episode_steps: int | None, reward_threshold: float | None
) -> EnvSpec:
    known, actions = env.spec, env.action_space
    if isinstance(actions, gymnasium.spaces.Discrete):
        raise ValueError(f"{name}: its actions are {actions}; DDPG's are continuous")
    observation = _bounds(name, "observations", env.observation_space)
    action = _bounds(name, "actions", env.action_space)
    if not np.issubdtype(actions.dtype, np.floating):
        raise ValueError(f"{name}: its actions are {actions.dtype}; DDPG's are continuous")
    if not np.isfinite(action).all():
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
    spec = spec_of(name, observation, action, max_episode_steps, reward_threshold)
    checks.env_spec(spec)
    return spec


def _bounds(name: str, what: str, space: gymnasium.Space) -> Bounds:
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


def _try(env: gymnasium.Env, spec: EnvSpec) -> None:
    """Reset and step a task once, and hold what it answers to its specification."""
    observation, _ = env.reset(seed=0)
    _check_numbers(f"{spec.id}: an observation of reset", observation, (spec.observation_dim,))
    action = 0.5 * (spec.action_low + spec.action_high)
    observation, reward, *_ = env.step(action.astype(env.action_space.dtype))
    _check_numbers(f"{spec.id}: an observation of step", observation, (spec.observation_dim,))
    _check_numbers(f"{spec.id}: a reward", reward, ())


def _check_numbers(what: str, found: Any, shape: tuple[int, ...]) -> None:
    array = np.asarray(found)
    if array.dtype.kind not in "fiub" or array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"{what} is {found!r}, not finite numbers of shape {shape}")
