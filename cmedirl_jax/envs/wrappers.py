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
            ValueError: for an unknown mode, a weight that is not finite, or a discount outside
                [0, 1].
        """
        gymnasium.utils.RecordConstructorArgs.__init__(
            self, reward=reward, mode=mode, weight=weight, discount=discount
        )
        gymnasium.Wrapper.__init__(self, env)
        self._pay = _Payment(reward, env.action_space, mode, weight, discount)
        self._observation: Any = None

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        """Reset the environment."""
        self._observation, info = self.env.reset(**kwargs)
        return self._observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Step the environment."""
        before = self._observation
        self._observation, reward, terminated, truncated, info = self.env.step(action)
        paid = self._pay(before, action, reward, self._observation, terminated)
        info = {**info, "environment_reward": reward}
        return self._observation, float(paid), terminated, truncated, info


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
        self._over = self._over & False
        self._observations, infos = self.env.reset(seed=seed, options=options)
        return self._observations, infos

    def step(self, actions: Any) -> Any:
        """Step the sub-environments; a step that only resets one pays nothing."""
        before, resets = self._observations, self._over
        self._observations, rewards, terminated, truncated, infos = self.env.step(actions)
        successors = stepping.successors(self.env, self._observations, infos)
        paid = np.asarray(self._pay(before, actions, rewards, successors, terminated))
        if self.env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP:
            self._over = terminated | truncated
        infos = {**infos, "environment_reward": rewards}
        return self._observations, np.where(resets, rewards, paid), terminated, truncated, infos


class _Payment:
    """What a step pays, of one environment or `[n]` of them."""

    def __init__(self, reward: Reward, actions: Any, mode: Mode, weight: float, discount: float):
        if mode not in ("replace", "add", "potential"):
            raise ValueError(f"mode: {mode!r} is none of replace, add, potential")
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
