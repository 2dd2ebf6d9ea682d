"""The environments in JAX, by Gymnasium's names."""

from collections.abc import Callable

import gymnasium

from cmedirl_jax.envs import mountain_car, pendulum, point_mass
from cmedirl_jax.envs.base import Env
from cmedirl_jax.envs.host import HostEnv, from_gymnasium
from cmedirl_jax.registries import Registry

ENVS: Registry[Callable[[], Env]] = Registry(
    "environment",
    {
        mountain_car.SPEC.id: mountain_car.make,
        pendulum.SPEC.id: pendulum.make,
        point_mass.SPEC.id: point_mass.make,
    },
)
"""Maps each name to the function that makes the environment."""


def make(id: str) -> Env:
    """Make an environment by its name.

    Raises:
        ValueError: if there is no such environment in JAX; the message lists those there are. If
            the environment gives itself another name.
    """
    env = ENVS[id]()
    if env.spec.id != id:
        raise ValueError(f"environment {id!r}: the id in its specification is {env.spec.id!r}")
    return env


def split_id(id: str) -> tuple[str, str]:
    """The module that registers a task, "" for none, and the name that it registers."""
    module, _, name = id.rpartition(":")
    return module, name


def find(id: str, *, asynchronous: bool = False) -> Env | HostEnv:
    """Make an environment of this library, or else Gymnasium's of that name.

    `gymnasium:Pendulum-v1` is Gymnasium's, in Gymnasium's way to name a module that has it.

    Args:
        id: the name.
        asynchronous: see `from_gymnasium`.

    Raises:
        ValueError: if neither knows the name, and as `make` and `from_gymnasium`.
    """
    if id in ENVS:
        return make(id)
    try:
        return from_gymnasium(id, asynchronous=asynchronous)
    except ValueError as error:
        # The names of ours go with Gymnasium's answer.
        if isinstance(error.__cause__, gymnasium.error.UnregisteredEnv):
            ours = f"{id!r}; there are: {', '.join(ENVS)}, and Gymnasium's."
            raise ValueError(f"unknown environment {ours} {error.__cause__}") from error
        raise


def register(id: str, make: Callable[[], Env]) -> None:
    """Add an environment of your own, to be made by its name.

    Args:
        id: the name.
        make: makes the environment, whose `spec.id` is that name.

    Raises:
        ValueError: if the name is taken.
    """
    if id in ENVS:
        raise ValueError(f"environment {id!r} is already registered")
    ENVS[id] = make
