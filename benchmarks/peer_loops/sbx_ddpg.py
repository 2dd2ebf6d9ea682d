"""DDPG of sbx (stable-baselines3's loop, networks in JAX), one seed, Gymnasium's environment."""

from sbx import DDPG

from benchmarks.peer_loops.stable_baselines_sizes import ENVIRONMENT, OPTIONS
from benchmarks.serving import serve_from_command_line

model = DDPG("MlpPolicy", ENVIRONMENT, **OPTIONS)

serve_from_command_line(lambda steps: model.learn(steps, reset_num_timesteps=False))
