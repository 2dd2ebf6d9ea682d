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
from cmedirl_jax.runs.load import LearnedCell, learned_cell
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
    found = learned(run, method, seed, n_demos)
    try:
        act = found.policies().of(seed - found.cell.key.first_seed)
    except ValueError as error:
        raise UserError(" ".join(str(error).split())) from error
    return Policy(found.task.id, found.method.name, act)


def learned(run: Path, method: str | None, seed: int, n_demos: int | None) -> LearnedCell:
    """What one of a run's learners has learned; its only method's if none is named.

    Raises:
        UserError: if there is no such run or learner, or there are several.
    """
    methods = run_folder.read(run)["config"]["methods"]
    if method is None and len(methods) > 1:
        raise UserError(f"--method: {run} has several: {', '.join(methods)}")
    try:
        return learned_cell(run, method or methods[0], seed, n_demos)
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
