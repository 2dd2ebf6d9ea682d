"""Pytrees and arrays on disk."""

from cmedirl_jax.io import atomic, checkpoint, export, npz

__all__ = ["atomic", "checkpoint", "export", "npz"]
