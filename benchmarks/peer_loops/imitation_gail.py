"""GAIL of imitation on DDPG of stable-baselines3: `python -m ... DEMONSTRATIONS.npz STEPS`.

Every call trains the agent of the next seed from the start, and says what it returns.
"""

import itertools
import sys
import tempfile

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers import TransformObservation
from imitation.algorithms.adversarial.gail import GAIL
from imitation.data.types import Transitions
from imitation.data.wrappers import RolloutInfoWrapper
from imitation.rewards.reward_nets import BasicRewardNet
from imitation.util import logger
from stable_baselines3 import DDPG
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv

from benchmarks.serving import serve_from_command_line

TASK, ROUND, PERIOD = "MountainCarContinuous-v0", 100, 4
torch.set_num_threads(1)
shown = dict(np.load(sys.argv[1]))
# The last step of each episode.
ends = np.append(np.diff(shown["episode"]) != 0, True)
space = gymnasium.make(TASK).observation_space


def scaled(observation: np.ndarray) -> np.ndarray:
    """Within -1 and 1, as in our networks."""
    return 2.0 * (observation - space.low) / (space.high - space.low) - 1.0


demonstrations = Transitions(
    obs=scaled(shown["observation"]),
    acts=shown["action"],
    infos=np.array([{}] * len(shown["action"])),
    next_obs=scaled(shown["next_observation"]),
    dones=ends,
)
silent = logger.configure(tempfile.mkdtemp(), [])
seeds = itertools.count()


def task() -> gymnasium.Env:
    """The task with scaled observations."""
    return TransformObservation(gymnasium.make(TASK), scaled)


def train(seed: int, steps: int) -> DDPG:
    """An agent after so many steps on the discriminator's reward alone."""
    tasks = DummyVecEnv([lambda: RolloutInfoWrapper(task())])
    tasks.seed(seed)
    agent = DDPG(
        "MlpPolicy",
        tasks,
        seed=seed,
        batch_size=32,
        buffer_size=12_000,
        learning_starts=200,
        tau=0.01,
        train_freq=1,
        action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(1), np.full(1, 0.5), dt=1.0),
        policy_kwargs={"net_arch": [64, 64]},
        device="cpu",
    )
    discriminator = BasicRewardNet(
        tasks.observation_space, tasks.action_space, use_next_state=False, hid_sizes=(64, 64)
    )
    trainer = GAIL(
        demonstrations=demonstrations,
        demo_batch_size=32,
        venv=tasks,
        gen_algo=agent,
        reward_net=discriminator,
        n_disc_updates_per_round=ROUND // PERIOD,
        gen_train_timesteps=ROUND,
        gen_replay_buffer_capacity=12_000,
        disc_opt_kwargs={"lr": 1e-3},
        custom_logger=silent,
        allow_variable_horizon=True,
    )
    trainer.train(steps)
    return agent


def advance(steps: int) -> dict[str, list[float]]:
    """Train the next seed, and judge it by the task's reward."""
    seed = next(seeds)
    agent = train(seed, steps)
    judge = task()
    judge.reset(seed=seed)
    mean, _ = evaluate_policy(agent, judge, n_eval_episodes=10, warn=False)
    return {"returns": [float(mean)]}


serve_from_command_line(advance)
