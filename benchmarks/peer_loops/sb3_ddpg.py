"""DDPG of stable-baselines3, one seed, on Gymnasium's environment."""

import torch
from stable_baselines3 import DDPG

from benchmarks.peer_loops.stable_baselines_sizes import ENVIRONMENT, OPTIONS
from benchmarks.serving import serve_from_command_line

torch.set_num_threads(1)
model = DDPG("MlpPolicy", ENVIRONMENT, device="cpu", **OPTIONS)

serve_from_command_line(lambda steps: model.learn(steps, reset_num_timesteps=False))
