"""What a user did wrong, as opposed to what the program did wrong."""


class UserError(Exception):
    """A mistake in the command line or a file: one line for stderr, exit code 2."""
