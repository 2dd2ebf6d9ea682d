"""How a command ends: with its results, or with a line and an exit code."""

import functools
from collections.abc import Callable
from typing import ParamSpec

from cmedirl_jax.runs.console import streams
from cmedirl_jax.runs.errors import UserError

Parameters = ParamSpec("Parameters")


def in_a_line(
    program: str,
) -> Callable[[Callable[Parameters, int]], Callable[Parameters, int]]:
    """Decorate a command's main function, which returns its exit code.

    A UserError ends it with a line and code 2, an OSError with a line and code 1. Output that
    nobody reads ends nothing.

    Args:
        program: the command's name, which begins the line.
    """

    def decorate(main: Callable[Parameters, int]) -> Callable[Parameters, int]:
        @functools.wraps(main)
        def ended(*args: Parameters.args, **kwargs: Parameters.kwargs) -> int:
            with streams.unfailing():
                try:
                    return main(*args, **kwargs)
                except (UserError, OSError) as error:
                    streams.complain(f"{program}: {error}")
                    return 2 if isinstance(error, UserError) else 1

        return ended

    return decorate
