"""Choices by name: a registry maps each name to all that belongs to it."""

from collections.abc import Mapping
from typing import NoReturn, TypeVar

Entry = TypeVar("Entry")


class Registry(dict[str, Entry]):
    """A dict whose error for an unknown name lists the known ones.

    `registry[name]` raises ValueError where a dict raises KeyError. Add an entry of your own with
    `registry[name] = entry`.

    Attributes:
        kind: what the entries are, in a word or two, for the message.
    """

    def __init__(self, kind: str, entries: Mapping[str, Entry]):
        super().__init__(entries)
        self.kind = kind

    def __missing__(self, name: str) -> NoReturn:
        raise ValueError(f"unknown {self.kind} {name!r}; there are: {', '.join(self)}")
