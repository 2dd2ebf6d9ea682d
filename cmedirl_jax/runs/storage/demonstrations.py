"""The demonstrations that a run keeps in its folder, the same for all of its cells."""

import hashlib
from pathlib import Path

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import sealing


def save(folder: Path, pool: Demonstrations) -> None:
    """Keep the run's demonstrations, and their digest in sha256sum's format, which comes last."""
    path = _path(folder)
    path.parent.mkdir(exist_ok=True)
    demonstrations.save(path, pool)
    with sealing.replacing(_digest_path(path)) as partial:
        partial.write_bytes(_digest(path) + f"  {path.name}\n".encode())


def load(folder: Path, env: Env) -> Demonstrations | None:
    """Those that the run keeps, or None if it does not yet.

    Raises:
        UserError: if they are not what the run kept.
    """
    path = _path(folder)
    try:
        digest = _digest_path(path).read_bytes().split()[:1]
        if digest != [_digest(path)]:
            raise UserError(
                f"--out: {path} is not what this run kept; bring that back, or remove it to train "
                "the experts again"
            )
        return demonstrations.load(path, env.spec)
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise UserError(f"--out: {error}") from error


def _path(folder: Path) -> Path:
    return folder / "demonstrations" / "pool.npz"


def _digest_path(path: Path) -> Path:
    return path.with_name(f"{path.name}.sha256")


def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).hexdigest().encode()
