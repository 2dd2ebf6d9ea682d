"""What a task itself can say of demonstrations that lack something."""

from typing import Any

import jax
import numpy as np

from cmedirl_jax.data import validation
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.types import Demonstrations, EnvSpec


def complete(
    demonstrations: Demonstrations, env: Env | HostEnv, params: Any = None
) -> Demonstrations:
    """Compute absent rewards and unobserved successors where the task allows it.

    It allows it where it can be set to an observation (`env.state_at`) and the actions are known.
    What is computed is right for tasks that draw nothing in `step`.

    Args:
        demonstrations: a pool whose observations and actions are within the task's bounds.
        env: the task.
        params: its parameters, default `env.default_params`.

    Returns:
        The pool, whose metadata name under "computed" what came from the task.

    Raises:
        ValueError: as `validation.absent`.
    """
    lacking = validation.absent(demonstrations)
    unseen = validation.unobserved(demonstrations)
    if isinstance(env, HostEnv) or env.state_at is None or "action" in lacking:
        return demonstrations
    if "reward" not in lacking and not unseen.any():
        return demonstrations
    made = jax.tree.map(np.asarray, demonstrations.transition)
    params = env.default_params if params is None else params
    answers = validation.steps(env, params, made)[0].astype(np.float32)
    size = env.spec.observation_dim

    # Fill in what is missing, and say so.
    metadata, computed = dict(demonstrations.metadata), []
    successors, rewards = made.next_observation.copy(), made.reward
    if unseen.any():
        successors[unseen] = answers[unseen, :size]
        metadata.pop(validation.REPEATED)
        computed.append("next_observation")
    if "reward" in lacking:
        rewards = answers[:, size]
        metadata["absent"] = [name for name in lacking if name != "reward"]
        computed.append("reward")
    metadata["computed"] = computed
    transition = made._replace(next_observation=successors, reward=rewards)
    return demonstrations._replace(transition=transition, metadata=metadata)


def clip(demonstrations: Demonstrations, spec: EnvSpec) -> Demonstrations:
    """Move actions onto the task's bounds where they are beyond; NaN stays."""
    transition = demonstrations.transition
    action = np.clip(np.asarray(transition.action), spec.action_low, spec.action_high)
    return demonstrations._replace(transition=transition._replace(action=action))
