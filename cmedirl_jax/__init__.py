"""Continuous maximum-entropy deep inverse reinforcement learning with hot-started DDPG, in JAX.

Learn a reward from demonstrations, and train on it:

    import cmedirl_jax as cm

    env = cm.envs.make("MountainCarContinuous-v0")
    pool = cm.demonstrations.load("pool.npz", env.spec)
    method = cm.METHODS["hs-me-ddpg"]
    result = cm.training.fit(key, env, method, pool, seeds=8, steps=12_000)

Training in JAX is pure functions over pytrees: the caller owns jit, vmap, donation and sharding.
Tasks of Gymnasium, which are stepped on the host, compile for themselves (`training.host`).

Tasks and data
    envs: environments by name, their interface, and your own.
    demonstrations: a pool of trajectories, its file, each learner's subset, and sampling.
    replay, episodes: the replay buffer, and where the latest episodes lie in it.

The agent
    networks: the actor and the critic.
    observation_statistics: what observations without bounds are normalised by.
    ddpg: deep deterministic policy gradient.
    exploration: behaviour policies and their densities.
    hot_start: the hot start of actor and critic from demonstrations (Eq. 11).

The reward
    irl: learns r_D from samples (Algorithm 1), with objectives, regularisers, GAIL and controls.
    rewards: networks for r_D.
    shaping: how r_D joins the environment's reward (Eq. 10).
    background: the samples that r_D is learned from.
    tabular: maximum-entropy IRL and control with a model (Eqs. 1 and 4-9).
    assess: is a reward any good: distances between rewards, occupancies, report cards.

Training
    METHODS, Method, Settings: the methods by name, and every choice that they share.
    training: Algorithm 2, for one seed or many.
    schedules: what happens at which step.
    seeds: many seeds in one program, on several devices.
    evaluation: noise-free returns.
    checkpoint: pytrees on disk.
    export: functions as files that other programs read without this library.

Types
    EnvSpec, Transition, RewardBatch, Network.
"""

from cmedirl_jax import assess, envs, irl, networks, observation_statistics, tabular, training
from cmedirl_jax.agents import ddpg, exploration, hot_start
from cmedirl_jax.data import demonstrations, episodes, replay
from cmedirl_jax.io import checkpoint, export
from cmedirl_jax.irl import reward_batches as background
from cmedirl_jax.irl import rewards, shaping
from cmedirl_jax.training import evaluation, schedules, seeds
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import EnvSpec, Network, RewardBatch, Transition

__all__ = [
    "METHODS",
    "EnvSpec",
    "Method",
    "Network",
    "RewardBatch",
    "Settings",
    "Transition",
    "assess",
    "background",
    "checkpoint",
    "ddpg",
    "demonstrations",
    "envs",
    "episodes",
    "evaluation",
    "exploration",
    "export",
    "hot_start",
    "irl",
    "networks",
    "observation_statistics",
    "replay",
    "rewards",
    "schedules",
    "seeds",
    "shaping",
    "tabular",
    "training",
]
