"""Our GAIL on DDPG: `python -m ... DEMONSTRATIONS.npz SEEDS STEPS`, each call with other seeds."""

import functools
import itertools
import sys
from typing import Any

import jax
import numpy as np

import cmedirl_jax as cm
from benchmarks.serving import serve_from_command_line
from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.data import demonstrations
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training.schedules import RewardSchedule, Schedule
from cmedirl_jax.training.settings import Settings

ALIKE = Settings(
    architecture=Architecture(hidden=(64, 64), critic_normalisation="none"),
    agent=DDPGHParams(actor_learning_rate=1e-3, critic_learning_rate=1e-3, tau=0.01),
    reward_network=RewardNetworkSettings(hidden=(64, 64)),
    reward_schedule=RewardSchedule(period=4, stop=None),
    schedule=Schedule(batch_size=32, learning_starts=200),
)
"""As the peer trains."""


def main() -> None:
    """Serve what the command line names."""
    path, seeds, _ = sys.argv[1:]
    env = cm.envs.make("MountainCarContinuous-v0")
    pool = demonstrations.load(path)

    @functools.partial(jax.jit, static_argnums=1)
    def fit(key: jax.Array, steps: int) -> jax.Array:
        result = cm.training.fit(
            key,
            env,
            "gail",
            pool,
            settings=ALIKE,
            seeds=int(seeds),
            steps=steps,
            evaluate_every=steps,
        )
        return result.evaluations.return_mean[:, -1]

    calls = itertools.count()

    def advance(steps: int) -> dict[str, Any]:
        returns = fit(jax.random.key(next(calls)), steps)
        return {"returns": np.asarray(returns, float).tolist()}

    serve_from_command_line(advance)


if __name__ == "__main__":
    main()
