"""Evaluate a policy that a run has learned, on the task's fixed starts.

Example: cmedirl evaluate results/tuned --method hs-me-ddpg --seed 3 --starts 100
"""

import contextlib
import dataclasses
from typing import Any

import jax
import numpy as np

from cmedirl_jax.commands import sources
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.ranges import Size
from cmedirl_jax.runs.console import screen
from cmedirl_jax.training import evaluation
from cmedirl_jax.training.evaluation import Rollouts


@dataclasses.dataclass(frozen=True)
class Options(sources.PolicyOptions):
    """Which policy, and from how many starts.

    Attributes:
        starts: Start states, which weigh as the task draws them.
    """

    starts: Size = 10


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    policy = sources.policy(options.folder, options.method, options.seed, options.n_demos)
    found = rollouts(sources.task(policy.task), policy.act, options.starts)
    screen.say(
        screen.console(),
        f"{policy.method}, seed {options.seed}: return {sources.spread(found.episode_return)} over "
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
