"""Training: the methods, the step of Algorithm 2, many seeds at once, and their evaluation."""

from cmedirl_jax.training import host
from cmedirl_jax.training.fit import Result, fit
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.step import Behaviour, Log
from cmedirl_jax.training.trainer import Trainer, make

__all__ = ["Behaviour", "Log", "Result", "Trainer", "TrainingState", "fit", "host", "make"]
