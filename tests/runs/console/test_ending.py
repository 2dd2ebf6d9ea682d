import errno
import os
import sys

import pytest

from cmedirl_jax.runs.console import ending
from cmedirl_jax.runs.errors import UserError
from experiments import report


def command(error=None):
    @ending.in_a_line("command")
    def main(line):
        print(line)
        if error is not None:
            raise error
        return 3

    return main


@pytest.mark.parametrize(
    ("error", "code", "line"),
    [
        (None, 3, ""),
        (UserError("--out: wrong"), 2, "command: --out: wrong\n"),
        (
            OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "table.csv"),
            1,
            "command: [Errno 28] No space left on device: 'table.csv'\n",
        ),
    ],
)
def test_a_command_ends_with_its_code_and_a_line(capsys, error, code, line):
    assert command(error)("results") == code
    assert capsys.readouterr() == ("results\n", line)


def test_output_that_nobody_reads_ends_nothing(monkeypatch):
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream:
        for output in (stream, None):
            monkeypatch.setattr(sys, "stdout", output)
            assert command()("results\n" * 10_000) == 3
            with pytest.raises(KeyError):
                command(KeyError("a mistake of ours"))("results")
            assert sys.stdout is output


def test_help_that_nobody_reads_is_no_failure(monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    with pytest.raises(SystemExit) as end:
        report.main(["--help"])
    assert end.value.code == 0
