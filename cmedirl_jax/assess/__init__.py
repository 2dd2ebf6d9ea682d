"""Is a learned reward any good: distances, occupancies, what it reads, agents on it alone."""

from cmedirl_jax.assess import card, coverage, distances, importance, occupancy, retraining

__all__ = ["card", "coverage", "distances", "importance", "occupancy", "retraining"]
