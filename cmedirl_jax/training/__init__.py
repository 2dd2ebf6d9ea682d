"""Training: the methods, the step of Algorithm 2, many seeds at once, and their evaluation."""

from cmedirl_jax.training.fit import Result, fit
from cmedirl_jax.training.initialise import TrainingState
from cmedirl_jax.training.step import Log, Trainer, make

__all__ = ["Log", "Result", "Trainer", "TrainingState", "fit", "make"]
