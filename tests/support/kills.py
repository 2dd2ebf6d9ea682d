"""Writers that are killed between two of their operations on files."""

import builtins
import io
import itertools
import os
from unittest import mock

CHANGES = ("fsync", "mkdir", "remove", "rename", "replace", "rmdir", "unlink")


class Killed(BaseException):
    """The process is dead: every further operation raises this too, in `finally` blocks as well."""


def killed_before(number, write):
    """Call `write`, and kill it before its change `number` on disk; returns whether it came there.

    A file that it would open for writing then is left open and empty, as by a kill among its bytes.
    """
    changes = itertools.count()
    dead = False

    def die_or_count():
        nonlocal dead
        dead = dead or next(changes) == number
        return dead

    def changed(function):
        def call(*arguments, **options):
            if die_or_count():
                raise Killed
            return function(*arguments, **options)

        return call

    def opened(file, mode="r", *arguments, **options):
        if dead:
            raise Killed
        if mode[0] in "wxa" and die_or_count():
            open_file(file, mode).close()
            raise Killed
        return open_file(file, mode, *arguments, **options)

    open_file = io.open
    with (
        mock.patch.multiple(os, **{name: changed(getattr(os, name)) for name in CHANGES}),
        mock.patch.object(io, "open", opened),
        mock.patch.object(builtins, "open", opened),
    ):
        try:
            write()
        except Killed:
            return True
    return False


def check_replaces(write, read, old, new, folder):
    """Check that a writer, killed at any moment, leaves the old value or the new one.

    Args:
        write: writes a value into a folder, over the one that is there.
        read: gives the value that lies in a folder.
        old: the value that is there.
        new: the value that replaces it.
        folder: a folder for the files.
    """
    found = []
    for number in itertools.count():
        place = folder / str(number)
        place.mkdir()
        write(place, old)
        names = sorted(place.iterdir())
        if not killed_before(number, lambda place=place: write(place, new)):
            break
        found.append(read(place))
        # The next one removes what this one left.
        write(place, new)
        assert read(place) == new
        assert sorted(place.iterdir()) == names
    assert found[0] == old
    assert found[-1] == new
    assert all(value in (old, new) for value in found)
