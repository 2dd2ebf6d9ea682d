"""Which environments there are, by Gymnasium's names."""

from cmedirl_jax.envs import mountain_car
from cmedirl_jax.envs.base import Env

_MAKERS = {mountain_car.SPEC.id: mountain_car.make}


def make(id: str) -> Env:
    """Make an environment by its Gymnasium name.

    Raises:
        ValueError: if there is no such environment; the message names those there are.
    """
    if id not in _MAKERS:
        raise ValueError(f"unknown environment {id!r}; there are: {', '.join(sorted(_MAKERS))}")
    return _MAKERS[id]()
