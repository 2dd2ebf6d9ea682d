"""Stable-baselines3 trains on a reward that was carried away, beside the task's own reward.

    cmedirl reward results/tuned --export r_d --method hs-me-ddpg --seed 3
    python -m pip install stable-baselines3
    python examples/sb3_on_learned_reward.py r_d --seeds 10

The reward is a file of numpy: of this library only the wrapper for Gymnasium's task is used.
"""

import argparse
import importlib.util
import json
from pathlib import Path

import gymnasium
import numpy as np
from gymnasium.wrappers import RescaleObservation
from stable_baselines3 import DDPG
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from cmedirl_jax.envs.wrappers import LearnedReward


def function_of(folder, name):
    """The function of a file of Python in a folder that was exported."""
    spec = importlib.util.spec_from_file_location(name, Path(folder) / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, name)


def returns(task, reward, mode, seed, steps):
    """Returns of r_e after every quarter of the training on a reward: [4]."""
    env = gymnasium.make(task)
    if mode != "r_e":
        env = LearnedReward(env, reward, mode)
    # Networks, batches, noise and scale of observations are as this library's.
    zeros = np.zeros(env.action_space.shape)
    alike = {
        "policy_kwargs": {"net_arch": [64, 64]},
        "batch_size": 32,
        "learning_starts": 200,
        "tau": 0.01,
        "action_noise": OrnsteinUhlenbeckActionNoise(zeros, zeros + 0.5, dt=1.0),
    }
    one = np.float32(1.0)
    agent = DDPG("MlpPolicy", RescaleObservation(env, -one, one), seed=seed, **alike)
    judge, found = RescaleObservation(gymnasium.make(task), -one, one), []
    judge.reset(seed=seed)
    for _ in range(4):
        agent.learn(steps // 4, reset_num_timesteps=False)
        found.append(evaluate_policy(agent, judge, n_eval_episodes=10, warn=False)[0])
    return found


def main():
    """Print the mean return after each quarter of the training, and how many seeds solve it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("folder", help="what `cmedirl reward RUN --export` wrote")
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--steps", type=int, default=12_000)
    options = parser.parse_args()
    reward = function_of(options.folder, "reward")
    task = json.loads((Path(options.folder) / "card.json").read_text())["task"]
    solved = gymnasium.make(task).spec.reward_threshold
    print("reward, seed: returns of r_e after each quarter")
    for mode in ("r_e", "replace"):
        found = []
        for seed in range(options.seeds):
            found.append(returns(task, reward, mode, seed, options.steps))
            print(f"{mode}, {seed}: {' '.join(f'{one:.1f}' for one in found[-1])}", flush=True)
        mean, last = np.mean(found, axis=0), np.array(found)[:, -1]
        counted = "" if solved is None else f"; {np.sum(last >= solved)} solved at last"
        print(f"{mode}, mean: {' '.join(f'{one:.1f}' for one in mean)}{counted}")


if __name__ == "__main__":
    main()
