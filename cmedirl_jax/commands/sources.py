"""What commands are given: a task, demonstrations of any format, a policy that was learned."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import numpy as np
import tyro

from cmedirl_jax import envs
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.ranges import Count, Size
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import load_policy
from cmedirl_jax.runs.storage import folder as run_folder


@dataclasses.dataclass(frozen=True)
class PolicyOptions:
    """Which policy.

    Attributes:
        folder: A run's folder.
        method: Which method's policy, where the run has several.
        seed: Of which learner.
        n_demos: Demonstrations of the learner, where the run has several numbers of them.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    method: str | None = None
    seed: Count = 0
    n_demos: Size | None = None


class Policy(NamedTuple):
    """A policy that was learned.

    Attributes:
        task: the name of its task.
        method: that learned it.
        act: `observation [..., O] -> action [..., A]`, not compiled.
    """

    task: str
    method: str
    act: Callable[[Any], jax.Array]


def policy(run: Path, method: str | None, seed: int, n_demos: int | None) -> Policy:
    """The best policy of one of a run's learners; its only method's if none is named.

    Raises:
        UserError: if there is no such run or policy, or there are several.
    """
    config = run_folder.read(run)["config"]
    if method is None and len(config["methods"]) > 1:
        raise UserError(f"--method: {run} has several: {', '.join(config['methods'])}")
    chosen: str = method or config["methods"][0]
    try:
        return Policy(config["env"], chosen, load_policy(run, chosen, seed, n_demos))
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from error


def spread(returns: np.ndarray) -> str:
    """Returns in words: their mean and standard deviation."""
    return f"{np.mean(returns):.4g} ± {np.std(returns):.3g}"


def task(name: str) -> Env | HostEnv:
    """The task of this name.

    Raises:
        UserError: if there is none.
    """
    try:
        return envs.find(name)
    except ValueError as error:
        raise UserError(f"--env: {' '.join(str(error).split())}") from error


def pool(source: str, format: str | None, env: Env | HostEnv | None) -> Demonstrations:
    """Demonstrations that are valid in themselves, and not yet held to a task.

    Raises:
        UserError: if they cannot be read.
    """
    try:
        return demonstrations.parse(source, format, None if env is None else env.spec)
    except (FileNotFoundError, ModuleNotFoundError, ValueError) as error:
        raise UserError(f"{' '.join(str(error).split())} (--env, --format)") from error
