"""`cmedirl`: says in a line what is missing where the extra `cli` is not installed."""

import sys


def main() -> int:
    """Run the command; returns its exit code."""
    try:
        from cmedirl_jax.commands import cmedirl
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("cmedirl_jax"):
            raise
        print(f"cmedirl: {error}; run: python -m pip install 'cmedirl-jax[cli]'", file=sys.stderr)
        return 2
    return cmedirl.main()
