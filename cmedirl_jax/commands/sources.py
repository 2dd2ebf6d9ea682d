"""What commands are given: a task, demonstrations of any format, a policy that was learned."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
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
        method: Which method's policy.
        seed: Of which learner.
        n_demos: Demonstrations of the learner, where the run has several numbers of them.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    method: str = "hs-me-ddpg"
    seed: Count = 0
    n_demos: Size | None = None


def policy(
    run: Path, method: str, seed: int, n_demos: int | None
) -> tuple[str, Callable[[Any], jax.Array]]:
    """The name of a run's task, and the best policy of one of its learners.

    Raises:
        UserError: if there is no such run or policy, or there are several.
    """
    task = run_folder.read(run)["config"]["env"]
    try:
        return task, load_policy(run, method, seed, n_demos)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from error


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
        raise UserError(" ".join(str(error).split())) from error
