import dataclasses

import pytest

from cmedirl_jax.ranges import Size
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError


@dataclasses.dataclass(frozen=True)
class Options:
    """Some options.

    Attributes:
        how_many: Of them.
    """

    how_many: Size = 3


def test_arguments_are_read_and_held_to_their_ranges(capsys):
    assert read(Options, "here.it", "What it does.", []) == Options()
    assert read(Options, "here.it", None, ["--how-many", "5"]) == Options(5)
    with pytest.raises(UserError, match="--how-many: must be at least 1, got 0"):
        read(Options, "here.it", None, ["--how-many", "0"])
    with pytest.raises(SystemExit):
        read(Options, "here.it", "What it does.", ["--help"])
    shown = capsys.readouterr().out
    assert "usage: python -m here.it" in shown
    assert "What it does." in shown
    assert "Of them." in shown
