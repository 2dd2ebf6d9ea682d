"""Evaluate a policy that a run has learned, on the task's fixed starts.

Example: cmedirl evaluate results/tuned --method hs-me-ddpg --seed 3 --starts 100
"""

import contextlib
import dataclasses
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from cmedirl_jax.commands import sources
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.ranges import Count, Size
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import load_policy
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.training import evaluation
from cmedirl_jax.training.evaluation import Rollouts


@dataclasses.dataclass(frozen=True)
class Options:
    """Which policy.

    Attributes:
        folder: A run's folder.
        method: Which method's policy.
        seed: Of which learner.
        n_demos: Demonstrations of the learner, where the run has several numbers of them.
        starts: Start states, which weigh as the task draws them.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    method: str = "hs-me-ddpg"
    seed: Count = 0
    n_demos: Size | None = None
    starts: Size = 10


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    env = sources.task(run_folder.read(options.folder)["config"]["env"])
    try:
        policy = load_policy(options.folder, options.method, options.seed, options.n_demos)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from error
    found = rollouts(env, policy, options.starts)
    screen.say(
        screen.console(),
        f"return {np.mean(found.episode_return):.4g} ± {np.std(found.episode_return):.2g} over "
        f"{options.starts} starts; {np.mean(found.length):.4g} steps; the task ended "
        f"{np.mean(found.terminated):.0%} of the episodes",
    )
    return 0


def rollouts(env: Env | HostEnv, policy: Any, starts: int) -> Rollouts:
    """Noise-free episodes of a policy from the task's fixed starts, leaves `[starts]`.

    Args:
        env: the task.
        policy: `observation [..., O] -> action [..., A]`.
        starts: how many.
    """
    if isinstance(env, Env):
        params = env.default_params
        play = jax.jit(lambda: evaluation.rollout(policy, env, params, env.starts(starts, params)))
        return jax.device_get(play())
    with contextlib.closing(env.vector(1)) as vector:
        found = evaluation.rollout_on_host(
            jax.jit(policy), vector, np.arange(starts), env.spec.max_episode_steps
        )
    return jax.tree.map(lambda leaf: leaf[0], found)
