"""The two ways in which a run ends before it is finished and nothing is broken."""

import signal


class UserError(Exception):
    """A mistake in the command line or a file: one line for stderr, exit code 2."""


class Interrupted(Exception):
    """The run stopped because a signal asked it to.

    Attributes:
        exit_code: 128 and the signal's number, as shells have it.
    """

    def __init__(self, number: int):
        super().__init__(signal.Signals(number).name)
        self.exit_code = 128 + number
