"""Settings as JSON values, and back."""

import dataclasses
import math
import types
import typing
from pathlib import Path
from typing import Any

import numpy as np

from cmedirl_jax.types import EnvSpec


def plain(value: Any) -> Any:
    """Dataclasses and NamedTuples as dicts, sequences and arrays as lists, infinities as text."""
    if dataclasses.is_dataclass(value):
        return {
            field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)
        }
    if hasattr(value, "_asdict"):
        return plain(value._asdict())
    if isinstance(value, dict):
        return {name: plain(item) for name, item in value.items()}
    if isinstance(value, list | tuple | np.ndarray):
        return [plain(item) for item in value]
    if isinstance(value, np.generic):
        return plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return str(value) if isinstance(value, Path) else value


def settings(kind: Any, value: Any) -> Any:
    """The value of type `kind` that `plain` turned into `value`.

    Args:
        kind: a dataclass, or the annotation of one of its fields.
        value: JSON values.

    Raises:
        ValueError: if the dataclass has other fields now.
    """
    arguments = typing.get_args(kind)
    if isinstance(kind, type) and dataclasses.is_dataclass(kind):
        kinds = typing.get_type_hints(kind)
        names = {field.name for field in dataclasses.fields(kind)}
        if names != value.keys():
            other = ", ".join(sorted(names ^ value.keys()))
            raise ValueError(f"was written by a version with other settings ({other})")
        return kind(**{name: settings(kinds[name], item) for name, item in value.items()})
    if typing.get_origin(kind) is tuple:
        return tuple(settings(arguments[0], item) for item in value)
    if typing.get_origin(kind) in (typing.Union, types.UnionType):
        # The only unions are of a type and None.
        return None if value is None else settings(arguments[0], value)
    return float(value) if kind is float else value


def spec(value: dict[str, Any]) -> EnvSpec:
    """The specification that `plain` turned into `value`."""
    bounds = ("observation_low", "observation_high", "action_low", "action_high")
    arrays = {name: np.array([float(x) for x in value[name]], np.float32) for name in bounds}
    return EnvSpec(**{**value, **arrays})
