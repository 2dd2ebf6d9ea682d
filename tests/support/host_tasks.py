"""Tasks of Gymnasium as somebody else would write them."""

import gymnasium
import numpy as np


class Dock(gymnasium.Env):
    """Bring a boat to rest at 0: observations without bounds, slower astern, no threshold."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)
    action_space = gymnasium.spaces.Box(np.float32([-0.5]), np.float32([1.0]))

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place, self.speed = self.np_random.uniform(-5.0, -3.0), 0.0
        return self._observe(), {}

    def step(self, action):
        assert self.action_space.contains(action)
        self.speed = 0.9 * self.speed + 0.4 * float(action[0])
        self.place += 0.1 * self.speed
        reward = -0.05 * abs(self.place) - 0.02 * abs(self.speed)
        return self._observe(), reward, self.place > 3.0, False, {}

    def _observe(self):
        return np.array([self.place, self.speed])


class Counting(gymnasium.Env):
    """Ends after as many steps as its seed's remainder says; observes [its seed, its steps]."""

    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float32)
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)

    def __init__(self, truncates=False):
        self.truncates = truncates
        self.number = -1

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        # Without a seed nobody asked for this episode.
        self.number, self.steps = -1 if seed is None else seed, 0
        return self._observe(), {}

    def step(self, action):
        assert np.isfinite(action).all()
        assert self.steps < self.length, "it has ended"
        self.steps += 1
        ended = self.steps == self.length
        return self._observe(), float(action[0]), ended and not self.truncates, ended, {}

    @property
    def length(self):
        return 2 + self.number % 3

    def _observe(self):
        return np.array([self.number, self.steps], np.float32)


gymnasium.register("Dock-v0", entry_point=Dock, max_episode_steps=60)
