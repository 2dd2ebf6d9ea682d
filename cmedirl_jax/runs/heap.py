"""The C library's heap, kept from spreading over the threads of a run."""

import ctypes
import os
import sys

_M_ARENA_MAX = -8
"""`malloc.h`; see mallopt(3)."""


def share(arenas: int) -> None:
    """Let all threads of this process allocate from so many of glibc's arenas, from here on.

    By default there are up to eight a core, and each keeps what compiling and saving once needed
    there. Does nothing where MALLOC_ARENA_MAX says how many, or where another C library is in use.
    """
    if not sys.platform.startswith("linux") or "MALLOC_ARENA_MAX" in os.environ:
        return
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is not None:
        mallopt(_M_ARENA_MAX, arenas)
