"""Mistakes of every kind on a real command line: a line, code 2, and the folder as it was."""

import concurrent.futures
import os
import shlex
import subprocess
import sys

import pytest

from cmedirl_jax.data import demonstrations
from tests.support import ROOT, pools

REFUSED = {
    "--seeds 0": "--seeds: must be at least 1, got 0",
    "--demos pipe": "--demos: pipe: not a regular file",
    "--demos cut.npz": "--demos: cut.npz: not a readable demonstrations file (",
    "--demos whole.npz --n-demos 3": "--n-demos: 3 asked, the pool holds 2",
    "--out whole.npz/run": "--out: cannot write to whole.npz/run (Not a directory)",
    "--preset smoke --out used": "--out: used/config.json is not a readable configuration (",
}
"""One for each moment at which a command refuses; tests/experiments/test_run_grid.py has all."""


def entries(folder):
    """Everything below a folder: files with their bytes."""
    return {
        path.relative_to(folder): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def folder(tmp_path):
    """An empty working folder, beside which the commands find their cache."""
    (tmp_path / "work").mkdir()
    return tmp_path / "work"


def run(arguments, folder):
    return subprocess.run(
        [sys.executable, "-m", "experiments.run_grid", *shlex.split(arguments)],
        cwd=folder,
        env=os.environ | {"PYTHONPATH": str(ROOT), "XDG_CACHE_HOME": str(folder.parent / "cache")},
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_a_mistake_ends_the_command_with_code_2_one_line_and_nothing_written(folder):
    os.mkfifo(folder / "pipe")
    demonstrations.save(folder / "whole.npz", pools.scripted(2))
    (folder / "cut.npz").write_bytes((folder / "whole.npz").read_bytes()[:-100])
    (folder / "used").mkdir()
    (folder / "used" / "config.json").write_text("{")
    before = entries(folder)
    with concurrent.futures.ThreadPoolExecutor(max_workers=2) as pool:
        finished = pool.map(lambda arguments: run(arguments, folder), REFUSED)
        for (arguments, line), done in zip(REFUSED.items(), finished, strict=True):
            assert (done.returncode, done.stdout) == (2, ""), arguments
            assert done.stderr.startswith(f"run_grid: {line}"), arguments
            assert done.stderr.count("\n") == 1, arguments
    assert entries(folder) == before


def test_what_the_parser_finds_keeps_its_form_and_code(folder):
    done = run("--tau 0.5", folder)
    assert (done.returncode, done.stdout) == (2, "")
    assert "--tau" in done.stderr
    assert not entries(folder)
