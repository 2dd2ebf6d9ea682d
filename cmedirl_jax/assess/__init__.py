"""Is a learned reward any good: distances between rewards, and occupancies."""

from cmedirl_jax.assess import card, coverage, distances, occupancy

__all__ = ["card", "coverage", "distances", "occupancy"]
