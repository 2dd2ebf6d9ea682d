"""Formats of demonstrations: which one a source is in, and reading and writing them."""

from cmedirl_jax.data.formats.npz import load, save
from cmedirl_jax.data.formats.reading import FORMATS, read

__all__ = ["FORMATS", "load", "read", "save"]
