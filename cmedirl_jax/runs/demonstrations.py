"""The demonstrations that a run is given: read, completed, and held to its task and its methods."""

import hashlib
from collections.abc import Sequence
from pathlib import Path

import jax
import numpy as np

from cmedirl_jax import checks
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.data.formats.reading import Actions
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells import pools
from cmedirl_jax.runs.config import DemosCheck, StudyConfig
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.training import needs
from cmedirl_jax.training.methods import METHODS


def load(
    path: Path,
    env: Env | HostEnv,
    check: DemosCheck,
    format: str | None = None,
    actions: Actions = "refuse",
) -> Demonstrations:
    """Read what `--demos` names, and compute what it lacks where the task can.

    Args:
        path: the file, the folder, or the id of a dataset.
        env: the task.
        check: what is asked of the demonstrations, see `StudyConfig`.
        format: a name in `demonstrations.FORMATS`; default by its looks.
        actions: what happens to actions out of bounds.

    Raises:
        UserError: if it is missing, damaged or foreign.
    """
    try:
        pool = demonstrations.parse(str(path), format, env.spec)
    except (FileNotFoundError, ModuleNotFoundError, ValueError) as error:
        raise UserError(f"--demos: {error}") from error
    except OSError as error:
        raise UserError(f"--demos: {path}: {error.strerror or error}") from error
    if actions == "clip":
        pool = demonstrations.clip(pool, env.spec)
    try:
        match check:
            case "dynamics":
                demonstrations.validate(pool, env.spec)
                pool = demonstrations.complete(pool, env)
                demonstrations.check(pool, env)
            case "spec":
                demonstrations.validate(pool, env.spec)
            case "none":
                checks.transition_shapes(
                    env.spec, pool.transition, pool.episode.shape, "transition"
                )
    except ValueError as error:
        raise UserError(f"--demos: {path}: {error}; see --check-demos") from error
    # The tables have a column of each.
    expert = pool.metadata.get("expert", "")
    if not isinstance(expert, str):
        raise UserError(f"--demos: {path}: expert in its metadata is {expert!r}, no text")
    steps = pool.metadata.get("expert_env_steps", 0)
    if type(steps) is not int or not 0 <= steps < 2**63:
        raise UserError(f"--demos: {path}: expert_env_steps in its metadata is {steps!r}, no count")
    return pool


def check_needs(config: StudyConfig, pool: Demonstrations) -> None:
    """Refuse demonstrations that lack what a method reads."""
    for name in config.methods:
        try:
            needs.check(METHODS[name], config.settings, demonstrations.absent(pool))
        except ValueError as error:
            raise UserError(f"--methods {name}: {error}") from error


def held(path: Path, pool: Demonstrations) -> int:
    """How many demonstrations each learner may draw from."""
    try:
        return pools.held(pool)
    except ValueError as error:
        raise UserError(f"--demos: {path}: {error}") from error


def check_enough(asked: Sequence[tuple[str, int]], held: int) -> None:
    """Refuse more demonstrations of a learner than there are."""
    most = max(n_demos for _, n_demos in asked)
    if most > held:
        raise UserError(f"--n-demos: {most} asked, the pool holds {held}")


def digest(path: Path, pool: Demonstrations | None) -> str | None:
    """The SHA-256 of a file, or of what was read elsewhere; None where nothing was read."""
    if path.is_file():
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    if pool is None:
        return None
    leaves = [np.asarray(leaf).tobytes() for leaf in jax.tree.leaves(pool[:3])]
    return hashlib.sha256(b"".join(leaves)).hexdigest()
