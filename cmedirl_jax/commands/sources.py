"""What commands are given: a task by its name, and demonstrations of any format."""

from cmedirl_jax import envs
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.errors import UserError


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
