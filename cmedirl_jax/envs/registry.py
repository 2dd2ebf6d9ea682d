"""The environments, by Gymnasium's names."""

from collections.abc import Callable

from cmedirl_jax.envs import mountain_car, pendulum, point_mass
from cmedirl_jax.envs.base import Env
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
        ValueError: if there is no such environment; the message lists those there are. If the
            environment gives itself another name.
    """
    env = ENVS[id]()
    if env.spec.id != id:
        raise ValueError(f"environment {id!r}: the id in its specification is {env.spec.id!r}")
    return env


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
