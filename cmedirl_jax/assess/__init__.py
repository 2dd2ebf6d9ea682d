"""Is a learned reward any good: distances between rewards, and occupancies."""

from cmedirl_jax.assess import coverage, distances, occupancy

__all__ = ["coverage", "distances", "occupancy"]
