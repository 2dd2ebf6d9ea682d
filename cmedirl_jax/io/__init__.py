"""Pytrees and arrays on disk."""

from cmedirl_jax.io import atomic, checkpoint, npz

__all__ = ["atomic", "checkpoint", "npz"]
