"""What a field of a settings class may hold, written beside it: ranges of numbers, choices.

A settings class annotates a field with one of the types below, or with `Annotated` and a `Range`:

    class Schedule:
        batch_size: Size = 32
        seed: Annotated[int, Range(0, 2**32 - 1, "between 0 and 2^32 - 1")] = 0

`check` reads these annotations, and `Literal`. Numbers and arrays on the host are checked; traced
ones pass.
"""

import dataclasses
import functools
import typing
from collections.abc import Iterator
from typing import Annotated, Any, Literal, NamedTuple

import jax
import numpy as np
from jax.core import Tracer

_FLOAT = np.finfo(np.float32)
_NUMBERS = (int, float, np.number, np.ndarray, jax.Array)


class Registered:
    """Beside a `Literal`: its choices are a registry's, to which users add."""


class Range(NamedTuple):
    """A closed interval. NaN lies outside.

    Attributes:
        low: the smallest value.
        high: the largest value.
        words: what a value must be, as it follows "must be" in a message.
        too_large: the same for a value above `high`, where another wording is clearer.
    """

    low: float
    high: float
    words: str
    too_large: str | None = None


# The library counts in int32 and computes in float32.
_LARGEST = 2**31 - 1
COUNT = Range(0, _LARGEST, "at least 0", "at most 2^31 - 1")
FINITE = Range(float(_FLOAT.min), float(_FLOAT.max), "finite")
NOT_NEGATIVE = FINITE._replace(low=0.0, words="at least 0 and finite")
POSITIVE = FINITE._replace(low=float(_FLOAT.tiny), words="positive and finite")
SHARE = Range(0.0, 1.0, "between 0 and 1")
BELOW_ONE = Range(0.0, 1.0 - float(_FLOAT.epsneg), "at least 0 and below 1")

Count = Annotated[int, COUNT]
Size = Annotated[int, COUNT._replace(low=1, words="at least 1")]
AtLeastTwo = Annotated[int, COUNT._replace(low=2, words="at least 2")]
NotNegative = Annotated[float, NOT_NEGATIVE]
Positive = Annotated[float, POSITIVE]
AtLeastOne = Annotated[float, FINITE._replace(low=1.0, words="at least 1 and finite")]
Share = Annotated[float, SHARE]
PositiveShare = Annotated[float, SHARE._replace(low=POSITIVE.low, words="above 0 and at most 1")]
BelowOne = Annotated[float, BELOW_ONE]


def check(settings: Any) -> None:
    """Refuse numbers out of their range, and strings that are none of the choices.

    Args:
        settings: a dataclass; its numbers, strings and nested dataclasses are checked.

    Raises:
        ValueError: naming the first field that is wrong, what it must be and what it is.
        TypeError: for a number whose field has no range.
    """
    for name, wrong in out_of_range(settings):
        raise ValueError(f"{name} {wrong}")


def out_of_range(settings: Any, prefix: str = "") -> Iterator[tuple[str, str]]:
    """Yield the dotted name of each field that `check` refuses, and what is wrong with it.

    Raises:
        TypeError: for a number whose field has no range.
    """
    choices = _choices_of(type(settings))
    for field, interval in of_fields(type(settings)).items():
        name, value = prefix + field, getattr(settings, field)
        if dataclasses.is_dataclass(value):
            yield from out_of_range(value, f"{name}.")
            continue
        # In a tuple, each part is checked.
        for part in value if isinstance(value, tuple) else (value,):
            if isinstance(part, str) and part not in (choices[field] or {part}):
                yield name, f"must be one of {', '.join(choices[field])}, got {part!r}"
            if isinstance(part, bool) or not isinstance(part, _NUMBERS):
                continue
            if interval is None:
                raise TypeError(f"{name} has no range: annotate its field with one")
            if wrong := complaint(interval, part):
                yield name, wrong


def complaint(interval: Range, values: Any) -> str | None:
    """What is wrong with the first number outside an interval, "must be ..."; None if none is."""
    if not known(values):
        return None
    array = np.asarray(values)
    places = np.argwhere(~((interval.low <= array) & (array <= interval.high)))
    if not len(places):
        return None
    place = tuple(places[0].tolist())
    number = array[place]
    too_large = interval.too_large is not None and number > interval.high
    words = interval.too_large if too_large else interval.words
    return f"must be {words}, got {number}" + (f" at {list(place)}" if place else "")


def known(values: Any) -> bool:
    """Whether this process can read the values now: they are not traced, nor on other hosts."""
    return not isinstance(values, Tracer) and getattr(values, "is_fully_addressable", True)


@functools.cache
def of_fields(settings: type) -> dict[str, Range | None]:
    """The range of each field of a dataclass; None where its annotation has none."""
    return {name: next(_ranges_in(hint), None) for name, hint in _annotations(settings).items()}


@functools.cache
def _choices_of(settings: type) -> dict[str, tuple[str, ...]]:
    """The strings that each field of a dataclass may hold; none where it may hold any."""
    return {name: tuple(_choices_in(hint)) for name, hint in _annotations(settings).items()}


def _annotations(settings: type) -> dict[str, Any]:
    hints = typing.get_type_hints(settings, include_extras=True)
    return {field.name: hints[field.name] for field in dataclasses.fields(settings)}


def _choices_in(annotation: Any) -> Iterator[str]:
    """The choices in an annotation and its parts; none where they are a registry's."""
    if Registered in getattr(annotation, "__metadata__", ()):
        return
    if typing.get_origin(annotation) is Literal:
        yield from typing.get_args(annotation)
        return
    for part in typing.get_args(annotation):
        yield from _choices_in(part)


def _ranges_in(annotation: Any) -> Iterator[Range]:
    """The ranges in an annotation and its parts: `Size | None` and `tuple[Size, ...]` have one."""
    for extra in getattr(annotation, "__metadata__", ()):
        if isinstance(extra, Range):
            yield extra
    for part in typing.get_args(annotation):
        yield from _ranges_in(part)
