"""A task of this library as Gymnasium's, one episode at a time.

env = envs.to_gymnasium(envs.make("Pendulum-v1"), render_mode="rgb_array")
"""

from typing import Any, ClassVar, NamedTuple

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.envs.registration import EnvSpec as GymnasiumSpec

from cmedirl_jax.envs.base import Env, Step
from cmedirl_jax.types import EnvSpec


class Episode(NamedTuple):
    """A running episode.

    Attributes:
        key: of its steps' randomness, and of all later episodes.
        time: `[]` uint32, steps so far.
        state: the task's.
    """

    key: jax.Array
    time: jax.Array
    state: Any


def begin(env: Env, params: Any, key: jax.Array) -> tuple[Episode, jax.Array]:
    """Begin an episode; also its first observation `[O]`."""
    reset_key, key = jax.random.split(key)
    state, observation = env.reset(reset_key, params)
    return Episode(key, jnp.zeros((), jnp.uint32), state), observation


def advance(env: Env, params: Any, episode: Episode, action: jax.Array) -> tuple[Episode, Step]:
    """Step an episode."""
    # The numbers 0 and 1 are those of the split that begins the next episode.
    step_key = jax.random.fold_in(episode.key, episode.time + 2)
    state, answer = env.step(step_key, episode.state, action, params)
    return episode._replace(time=episode.time + 1, state=state), answer


def spaces(spec: EnvSpec) -> tuple[gymnasium.spaces.Box, gymnasium.spaces.Box]:
    """The spaces of observations and of actions."""
    return (
        gymnasium.spaces.Box(spec.observation_low, spec.observation_high, dtype=np.float32),
        gymnasium.spaces.Box(spec.action_low, spec.action_high, dtype=np.float32),
    )


class Drawing:
    """Draws states of a task in Gymnasium's environment of the same name.

    Attributes:
        metadata: of a task that Gymnasium can draw.
        modes: the ways to draw this task; none where Gymnasium has no picture of it.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["human", "rgb_array"], "render_fps": 30}

    def __init__(self, env: Env, render_mode: str | None):
        """Raises ValueError if Gymnasium cannot draw the task so."""
        self._env, self._drawn = env, None
        self.modes = [] if env.gymnasium_state is None else self.metadata["render_modes"]
        if render_mode is None:
            return
        if render_mode not in self.modes:
            raise ValueError(
                f"render_mode: {env.spec.id} has no picture {render_mode!r}; there are {self.modes}"
            )
        self._drawn = gymnasium.make(env.spec.id, render_mode=render_mode)
        self._drawn.reset(seed=0)

    def draw(self, state: Any, action: Any = None) -> Any:
        """A frame `[height, width, 3]` uint8, or None where it goes to the screen."""
        if self._drawn is None or self._env.gymnasium_state is None:
            return None
        drawn: Any = self._drawn.unwrapped
        drawn.state = self._env.gymnasium_state(state)
        if hasattr(drawn, "last_u"):
            # The pendulum shows the torque as an arrow.
            drawn.last_u = None if action is None else float(action[0])
        return self._drawn.render()

    def close(self) -> None:
        """Close the window."""
        if self._drawn is not None:
            self._drawn.close()


class GymnasiumEnv(gymnasium.Env[np.ndarray, np.ndarray]):
    """See `to_gymnasium`."""

    def __init__(self, env: Env, params: Any = None, render_mode: str | None = None):
        """Its functions are compiled at the first call."""
        params = env.default_params if params is None else params
        spec = env.spec
        self._drawing = Drawing(env, render_mode)
        self.metadata = {**Drawing.metadata, "render_modes": self._drawing.modes}
        self.observation_space, self.action_space = spaces(spec)
        self.render_mode = render_mode
        self.spec = GymnasiumSpec(
            spec.id,
            entry_point=f"{__name__}:{type(self).__name__}",
            max_episode_steps=spec.max_episode_steps,
            reward_threshold=spec.reward_threshold,
            kwargs={"env": env, "params": params, "render_mode": render_mode},
        )
        self._begin = jax.jit(lambda key: begin(env, params, key))
        self._advance = jax.jit(lambda episode, action: advance(env, params, episode, action))
        self._episode: Episode | None = None
        self._action: np.ndarray | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """Begin an episode; the seed says what all later ones draw, too."""
        super().reset(seed=seed)
        del options
        if seed is not None or self._episode is None:
            key = jax.random.key(first_seed(self.np_random))
        else:
            key = self._episode.key
        self._episode, observation = self._begin(key)
        self._action = None
        self._show()
        return np.array(observation), {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """Step the episode; the time limit of the specification truncates it.

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        action = np.asarray(action, np.float32)
        self._episode, answer = self._advance(self._episode, action)
        self._action = action
        self._show()
        observation, reward, terminated, truncated = jax.device_get(answer)
        return np.array(observation), float(reward), bool(terminated), bool(truncated), {}

    def render(self) -> Any:
        """A frame `[height, width, 3]` uint8; None in the mode "human".

        Raises:
            gymnasium.error.ResetNeeded: before the first reset.
        """
        if self._episode is None:
            raise gymnasium.error.ResetNeeded("call reset before render")
        return self._drawing.draw(self._episode.state, self._action)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._drawing.close()

    def _show(self) -> None:
        if self.render_mode == "human":
            self.render()


def first_seed(generator: np.random.Generator) -> int:
    """A number for `jax.random.key`."""
    return int(generator.integers(2**32, dtype=np.uint32))


def to_gymnasium(
    env: Env, params: Any = None, *, render_mode: str | None = None
) -> gymnasium.Env[np.ndarray, np.ndarray]:
    """Make a task of this library one of Gymnasium's.

    Args:
        env: the task.
        params: its parameters, default `env.default_params`.
        render_mode: "rgb_array" or "human", where Gymnasium has a picture of the task.

    Raises:
        ValueError: if Gymnasium cannot draw the task.
    """
    return GymnasiumEnv(env, params, render_mode)
