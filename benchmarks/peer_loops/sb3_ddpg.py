"""DDPG of stable-baselines3, one seed, on Gymnasium's environment."""

import numpy as np
import torch
from stable_baselines3 import DDPG
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from benchmarks.serving import serve_from_command_line

torch.set_num_threads(1)
model = DDPG(
    "MlpPolicy",
    "MountainCarContinuous-v0",
    buffer_size=12_000,
    learning_starts=200,
    batch_size=32,
    tau=0.01,
    train_freq=1,
    gradient_steps=1,
    action_noise=OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.5 * np.ones(1), theta=0.15, dt=1.0),
    policy_kwargs={"net_arch": [64, 64]},
    device="cpu",
)

serve_from_command_line(lambda steps: model.learn(steps, reset_num_timesteps=False))
