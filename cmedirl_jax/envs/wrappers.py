"""Wrappers of Gymnasium's that pay a learned reward, so that any of its agents can train on it.

    r_d = jax.jit(load_reward("results/tuned", "hs-me-ddpg", seed=3))
    env = LearnedReward(gymnasium.make("MountainCarContinuous-v0"), r_d, mode="add")

The task's own reward stands in the info as "environment_reward".
"""

from collections.abc import Callable
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from cmedirl_jax import checks
from cmedirl_jax.envs import stepping
from cmedirl_jax.ranges import FINITE

Reward = Callable[[Any, Any], Any]
"""`(observation [..., O], action [..., A]) -> [...]`, as `runs.load_reward` gives it."""
Mode = Literal["replace", "add", "potential"]


class LearnedReward(gymnasium.Wrapper, gymnasium.utils.RecordConstructorArgs):
    """Pay a learned reward in place of the task's, on top of it, or as a potential."""

    def __init__(
        self,
        env: gymnasium.Env,
        reward: Reward,
        mode: Mode = "replace",
        weight: float = 1.0,
        discount: float = 0.99,
    ):
        """Wrap an environment.

        Args:
            env: the environment.
            reward: r_D, compiled or not.
            mode: "replace": weight r_D(s, a); "add": r_e + weight r_D(s, a) (Eq. 10); "potential":
                r_e + weight (discount Phi(s') - Phi(s)) for a reward Phi of states, which does not
                read the action and is 0 past a termination (Ng 1999).
            weight: of the learned reward.
            discount: of the agent; a potential needs it.

        Raises:
            ValueError: for actions that are no box, an unknown mode, a weight that is not finite,
                or a discount outside [0, 1].
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, reward=reward, mode=mode, weight=weight, discount=discount
        )
        gymnasium.Wrapper.__init__(self, env)
        self._pay = _Payment(reward, env.action_space, mode, weight, discount)
        self._observation: Any = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the environment."""
        observation, info = self.env.reset(**kwargs)
        self._observation = np.array(observation)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        paid = self._pay(self._observation, action, reward, observation, terminated)
        # A copy: the environment may write over the array that it gave.
        self._observation = np.array(observation)
        info = {**info, "environment_reward": reward}
        return observation, float(paid), terminated, truncated, info


class LearnedRewardVector(VectorWrapper):
    """`LearnedReward` for vector environments in every autoreset mode."""

    def __init__(
        self,
        env: VectorEnv,
        reward: Reward,
        mode: Mode = "replace",
        weight: float = 1.0,
        discount: float = 0.99,
    ):
        """Wrap a vector environment; see `LearnedReward` for the arguments and errors."""
        super().__init__(env)
        self._pay = _Payment(reward, env.action_space, mode, weight, discount)
        self._observations: Any = None
        self._over = np.zeros(env.num_envs, bool)

    def reset(self, *, seed: Any = None, options: dict[str, Any] | None = None) -> Any:
        """Reset the sub-environments, or those of `options["reset_mask"]`."""
        # Gymnasium's vectors take the mask out of the options.
        mask = (options or {}).get("reset_mask", np.ones(self.num_envs, bool))
        observations, infos = self.env.reset(seed=seed, options=options)
        self._over = self._over & ~mask
        self._observations = np.array(observations)
        return observations, infos

    def step(self, actions: Any) -> Any:
        """Step the sub-environments; a step that only resets one pays nothing."""
        resets = self._over
        observations, rewards, terminated, truncated, infos = self.env.step(actions)
        successors = stepping.successors(self.env, observations, infos)
        paid = self._pay(self._observations, actions, rewards, successors, terminated)
        if self.env.metadata.get("autoreset_mode") is AutoresetMode.NEXT_STEP:
            self._over = terminated | truncated
        self._observations = np.array(observations)
        every = np.ones(self.num_envs, bool)
        infos = {**infos, "environment_reward": rewards, "_environment_reward": every}
        return observations, np.where(resets, rewards, paid), terminated, truncated, infos


class _Payment:
    """What a step pays, of one environment or `[n]` of them."""

    def __init__(self, reward: Reward, actions: Any, mode: Mode, weight: float, discount: float):
        if mode not in ("replace", "add", "potential"):
            raise ValueError(f"mode: {mode!r} is none of replace, add, potential")
        if not isinstance(actions, gymnasium.spaces.Box):
            raise ValueError(f"its actions are {actions}, not a Box")
        checks.within(FINITE, weight=weight)
        checks.shares(discount=discount)
        self._reward, self._actions = reward, actions
        self._mode, self._weight, self._discount = mode, weight, discount

    def __call__(self, before: Any, action: Any, reward: Any, after: Any, terminated: Any) -> Any:
        # The reward was learned from actions within their bounds.
        action = np.clip(action, self._actions.low, self._actions.high)
        learned = np.asarray(self._reward(before, action))
        if self._mode == "potential":
            following = np.where(terminated, 0.0, self._reward(after, action))
            learned = self._discount * following - learned
        return self._weight * learned + (0.0 if self._mode == "replace" else reward)
