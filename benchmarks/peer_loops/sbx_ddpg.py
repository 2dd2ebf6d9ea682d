"""DDPG of sbx (stable-baselines3's loop, networks in JAX), one seed, Gymnasium's environment."""

import numpy as np
from sbx import DDPG
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

from benchmarks.serving import serve_from_command_line

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
)

serve_from_command_line(lambda steps: model.learn(steps, reset_num_timesteps=False))
