"""Many episodes of a task of this library as one of Gymnasium's vector environments.

    vector = envs.to_gymnasium_vector(envs.make("Pendulum-v1"), 1_000)

One compiled call steps all of them. With the same seed a sub-environment goes through the same
episodes as `to_gymnasium`, in every autoreset mode.
"""

import functools
from collections.abc import Sequence
from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.utils import seeding
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from cmedirl_jax import checks
from cmedirl_jax.envs import gymnasium_env
from cmedirl_jax.envs.base import Env, Step
from cmedirl_jax.envs.gymnasium_env import Drawing, Episode


class GymnasiumVectorEnv(VectorEnv[np.ndarray, np.ndarray, np.ndarray]):
    """See `to_gymnasium_vector`."""

    _drawing: Drawing | None = None

    def __init__(
        self,
        env: Env,
        num_envs: int,
        params: Any = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ):
        """Its functions are compiled at the first call."""
        checks.sizes(num_envs=num_envs)
        if render_mode == "human":
            raise ValueError("render_mode: a window shows one episode; draw a vector by rgb_array")
        self._drawing = Drawing(env, render_mode)
        params = env.default_params if params is None else params
        self.num_envs = num_envs
        self.mode = AutoresetMode(autoreset_mode)
        modes = [mode for mode in self._drawing.modes if mode != "human"]
        self.metadata = {**Drawing.metadata, "render_modes": modes, "autoreset_mode": self.mode}
        self.single_observation_space, self.single_action_space = gymnasium_env.spaces(env.spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.render_mode = render_mode
        self._begin = jax.jit(jax.vmap(functools.partial(gymnasium_env.begin, env, params)))
        self._begin_some = jax.jit(functools.partial(_begin_some, env, params))
        self._step = jax.jit(functools.partial(_STEPS[self.mode], env, params))
        self._episodes: Any = None
        self._observations: Any = None
        self._over = np.zeros(num_envs, bool)
        self._actions: np.ndarray | None = None

    def reset(
        self,
        *,
        seed: int | Sequence[int | None] | None = None,
        options: dict[str, Any] | None = None,
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin episodes: in all sub-environments, or in those of `options["reset_mask"]`.

        Raises:
            ValueError: for a mask that is no numpy array of `num_envs` bools or names none, or
                another number of seeds.
        """
        super().reset(seed=seed if isinstance(seed, int) else None)
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        _check_mask(mask, self.num_envs)
        keys = self._keys(seed)
        if self._episodes is None:
            self._episodes, self._observations = self._begin(keys)
        else:
            self._episodes, self._observations = self._begin_some(
                self._episodes, self._observations, keys, mask
            )
        self._over = self._over & ~mask
        self._actions = None
        return np.array(self._observations), {}

    def _keys(self, seed: int | Sequence[int | None] | None) -> jax.Array:
        """What each sub-environment draws from: its seed's key, or what it would draw from next."""
        if isinstance(seed, (int, np.integer)):
            seed = [int(seed) + index for index in range(self.num_envs)]
        if seed is None and self._episodes is not None:
            return self._episodes.key
        seeds = [None] * self.num_envs if seed is None else list(seed)
        if len(seeds) != self.num_envs:
            raise ValueError(f"seed: {len(seeds)} seeds for {self.num_envs} sub-environments")
        generators = [seeding.np_random(one)[0] for one in seeds]
        keys = jax.vmap(jax.random.key)(
            np.array([gymnasium_env.first_seed(each) for each in generators], np.uint32)
        )
        if self._episodes is None:
            return keys
        seeded = np.array([one is not None for one in seeds])
        return jnp.where(seeded, keys, self._episodes.key)

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """Step every sub-environment, and reset those that ended as the autoreset mode says.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset; without autoreset also where an
                episode has ended.
        """
        if self._episodes is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        if self.mode is AutoresetMode.DISABLED and self._over.any():
            raise gymnasium.error.ResetNeeded(
                f"sub-environments {np.flatnonzero(self._over).tolist()} have ended: reset them"
            )
        actions = np.asarray(actions, np.float32)
        self._episodes, self._observations, answer = self._step(self._episodes, actions, self._over)
        self._actions = actions
        successors, rewards, terminated, truncated = jax.tree.map(np.array, answer)
        ended = terminated | truncated
        self._over = ended & (self.mode is not AutoresetMode.SAME_STEP)
        infos = {}
        if self.mode is AutoresetMode.SAME_STEP and ended.any():
            final = np.full(self.num_envs, None, dtype=object)
            for index in np.flatnonzero(ended):
                final[index] = successors[index]
            infos = {
                "final_obs": final,
                "_final_obs": ended,
                "final_info": {},
                "_final_info": ended,
            }
        return np.array(self._observations), rewards, terminated, truncated, infos

    def render(self) -> tuple[Any, ...] | None:
        """A frame of each sub-environment.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._episodes is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        assert self._drawing is not None
        states = jax.device_get(self._episodes.state)
        return tuple(
            self._drawing.draw(
                jax.tree.map(lambda leaf, index=index: leaf[index], states),
                None if self._actions is None else self._actions[index],
            )
            for index in range(self.num_envs)
        )

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        del kwargs
        if self._drawing is not None:
            self._drawing.close()


def _begin_some(
    env: Env, params: Any, episodes: Episode, observations: jax.Array, keys: jax.Array, mask: Any
) -> tuple[Episode, jax.Array]:
    """Begin those episodes `[n]` that `mask` marks."""
    begin = jax.vmap(functools.partial(gymnasium_env.begin, env, params))
    running = (episodes, observations)
    # Most steps end no episode.
    return jax.lax.cond(jnp.any(mask), lambda: _where(mask, begin(keys), running), lambda: running)


def _step(env: Env, params: Any, episodes: Episode, actions: jax.Array, over: Any):
    """Step; reset nothing."""
    del over
    advance = functools.partial(gymnasium_env.advance, env, params)
    episodes, answer = jax.vmap(advance)(episodes, actions)
    return episodes, answer.observation, answer


def _step_and_reset(env: Env, params: Any, episodes: Episode, actions: jax.Array, over: Any):
    """Step, and begin another episode where one ended."""
    episodes, observations, answer = _step(env, params, episodes, actions, over)
    ended = answer.terminated | answer.truncated
    episodes, observations = _begin_some(env, params, episodes, observations, episodes.key, ended)
    return episodes, observations, answer


def _reset_or_step(env: Env, params: Any, episodes: Episode, actions: jax.Array, over: Any):
    """Step, or begin another episode where one was `over` before."""
    stepped, observations, answer = _step(env, params, episodes, actions, over)
    episodes, observations = _begin_some(env, params, stepped, observations, episodes.key, over)
    reward = jnp.where(over, 0.0, answer.reward)
    answer = Step(observations, reward, answer.terminated & ~over, answer.truncated & ~over)
    return episodes, observations, answer


_STEPS = {
    AutoresetMode.NEXT_STEP: _reset_or_step,
    AutoresetMode.SAME_STEP: _step_and_reset,
    AutoresetMode.DISABLED: _step,
}


def _check_mask(mask: Any, count: int) -> None:
    """Refuse what Gymnasium's own vectors refuse as a `reset_mask`."""
    if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_ or mask.shape != (count,):
        raise ValueError(f"reset_mask: expected a numpy array of {count} bools, got {mask!r}")
    if not mask.any():
        raise ValueError("reset_mask: it names no sub-environment")


def _where(mask: Any, on_true: Any, on_false: Any) -> Any:
    """`jnp.where` over leaves `[n, ...]`."""

    def choose(x: jax.Array, y: jax.Array) -> jax.Array:
        return jnp.where(jnp.reshape(mask, (-1,) + (1,) * (x.ndim - 1)), x, y)

    return jax.tree.map(choose, on_true, on_false)


def to_gymnasium_vector(
    env: Env,
    num_envs: int,
    params: Any = None,
    *,
    autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
    render_mode: str | None = None,
) -> VectorEnv[np.ndarray, np.ndarray, np.ndarray]:
    """Make many copies of a task of this library one vector environment of Gymnasium's.

    Args:
        env: the task.
        num_envs: how many sub-environments.
        params: the task's parameters, default `env.default_params`.
        autoreset_mode: who resets what has ended, and when, as Gymnasium defines it.
        render_mode: "rgb_array", where Gymnasium has a picture of the task.

    Raises:
        ValueError: if `num_envs` is not positive, for an unknown mode, or if Gymnasium cannot draw
            the task.
        TypeError: if `num_envs` is not an integer.
    """
    return GymnasiumVectorEnv(env, num_envs, params, autoreset_mode, render_mode)
