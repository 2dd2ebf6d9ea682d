"""Options that give stable-baselines3 and sbx the same work as our loop."""

import numpy as np
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

ENVIRONMENT = "MountainCarContinuous-v0"
OPTIONS = {
    "buffer_size": 12_000,
    "learning_starts": 200,
    "batch_size": 32,
    "tau": 0.01,
    "train_freq": 1,
    "gradient_steps": 1,
    "action_noise": OrnsteinUhlenbeckActionNoise(np.zeros(1), 0.5 * np.ones(1), theta=0.15, dt=1.0),
    "policy_kwargs": {"net_arch": [64, 64]},
}
