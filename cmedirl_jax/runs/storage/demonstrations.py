"""The demonstrations that a run keeps in its folder, the same for all of its cells."""

from pathlib import Path

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import sealing

FOLDER, FILE = "demonstrations", "pool.npz"


def save(folder: Path, pool: Demonstrations) -> None:
    """Keep the run's demonstrations, sealed."""
    with sealing.sealed(folder / FOLDER, {}) as unfinished:
        demonstrations.save(unfinished / FILE, pool)


def load(folder: Path) -> Demonstrations | None:
    """The demonstrations that the run keeps, or None if it keeps none yet.

    They were held to the task before they were kept.

    Raises:
        UserError: if they are not as they were written.
    """
    path = folder / FOLDER
    if not path.exists():
        return None
    try:
        sealing.read(path)
        return demonstrations.load(path / FILE)
    except sealing.Damaged as error:
        raise UserError(
            f"{path} {error}; bring it back, or remove it to train the experts again"
        ) from error
    except (OSError, ValueError, sealing.OtherSchema) as error:
        raise UserError(f"{path}: {error}") from error
