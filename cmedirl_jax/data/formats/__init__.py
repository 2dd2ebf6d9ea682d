"""Formats of demonstrations: which one a source is in, and reading and writing them."""

from cmedirl_jax.data.formats.npz import load, save
from cmedirl_jax.data.formats.reading import FORMATS, parse, read

__all__ = ["FORMATS", "load", "parse", "read", "save"]
