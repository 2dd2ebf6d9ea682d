"""Runs that are killed, stopped, started twice or out of disk, as real processes."""

import contextlib
import glob
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import chex
import jax
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from cmedirl_jax.data import demonstrations
from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs import start
from cmedirl_jax.runs.cluster.base import ALONE
from cmedirl_jax.runs.storage import cells
from experiments import report, run_grid
from tests.support import ROOT, pools

# Orbax says so on every load that names no shardings.
pytestmark = pytest.mark.filterwarnings("ignore:Sharding info not provided:UserWarning")

STEPS = 1500
RUN = (
    *("--methods", "hs-me-ddpg", "--n-demos", "1", "2", "--seeds", "4"),
    *("--max-steps", str(STEPS), "--architecture.hidden", "8", "--hot-start.steps", "20"),
    *("--devices", "1", "--checkpoint-every", "0"),
)
"""Two cells of the same program, six chunks each, every one of which is saved."""
CONTINUE = "start the same command again to go on\n"
ISOLATED = ("unshare", "--map-root-user", "--mount")
LIMIT = 300.0
"""Seconds after which a process that should have ended is one that hangs."""


class Runs:
    """The same run in any folder, any number of times."""

    def __init__(self, folder, environment):
        self.folder, self.environment = folder, environment
        self.demos = folder / "demos.npz"
        demonstrations.save(self.demos, pools.scripted(3))

    def command(self, out):
        program = (sys.executable, "-m", "experiments.run_grid")
        return (*program, *RUN, "--demos", str(self.demos), "--out", str(out))

    def start(self, out, *options, prefix=(), **environment):
        return subprocess.Popen(
            (*prefix, *self.command(out), *options),
            cwd=ROOT,
            env=self.environment | environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def finish(self, out, *options):
        """Run until the end; returns what was printed."""
        process = self.start(out, *options)
        output, errors = process.communicate(timeout=LIMIT)
        assert process.returncode == 0, errors
        assert not errors
        return output


@pytest.fixture(scope="module")
def runs(tmp_path_factory, unoptimised):
    return Runs(tmp_path_factory.mktemp("runs"), os.environ | unoptimised)


@pytest.fixture(scope="module")
def whole(runs):
    """The folder of a run that nothing befell."""
    runs.finish(runs.folder / "whole")
    return runs.folder / "whole"


def assert_same_run(folder, whole):
    for name in cells.TABLES:
        assert_frame_equal(
            pl.read_parquet(folder / f"{name}.parquet"), pl.read_parquet(whole / f"{name}.parquet")
        )
    assert (folder / "summary.csv").read_bytes() == (whole / "summary.csv").read_bytes()
    left, expected = (
        {path.relative_to(run) for run in (of,) for path in run.rglob("*") if path.is_file()}
        for of in (folder, whole)
    )
    # Orbax names its data files at random.
    assert {path for path in left if "d" not in path.parts} == {
        path for path in expected if "d" not in path.parts
    }
    learned = [path.relative_to(whole) for path in whole.glob("cells/*/[pr]*s") if path.is_dir()]
    assert len(learned) == 2 * len(list((whole / "cells").iterdir()))
    for path in learned:
        found, wanted = checkpoint.load(folder / path), checkpoint.load(whole / path)
        chex.assert_trees_all_equal(found, wanted, strict=True)


def paths(run, pattern):
    """What there is; `Path.glob` trips over folders that vanish meanwhile."""
    return [Path(path) for path in glob.glob(str(run / pattern))]


def progress(run):
    """Steps behind the cells of a run, as far as they are saved."""
    finished = [path.name for path in paths(run, "cells/[!.]*")]
    begun = [
        path for path in paths(run, "checkpoints/*/[0-9]*") if path.parent.name not in finished
    ]
    return STEPS * len(finished) + max((int(path.name) for path in begun), default=0)


def wait_for(process, condition):
    """Wait until `condition` holds or the process has ended."""
    deadline = time.monotonic() + LIMIT
    while process.poll() is None and not condition():
        assert time.monotonic() < deadline, "it hangs"
        time.sleep(0.005)


def killed(process):
    """SIGKILL the process; whether it was alive."""
    process.kill()
    process.communicate(timeout=LIMIT)
    return process.returncode == -signal.SIGKILL


def killed_between(runs, run, first, last):
    """Killed at a random moment, when so many steps are saved."""
    moments = random.Random(first)
    steps = moments.randint(first, last)
    process = runs.start(run)
    wait_for(process, lambda: progress(run) >= steps)
    time.sleep(moments.uniform(0.0, 0.2))
    assert killed(process)


def stopped_without_a_reader(runs, run):
    """As `| tee log`, where a signal ends `tee` too."""
    reader, writer = os.pipe()
    process = subprocess.Popen(
        runs.command(run), cwd=ROOT, env=runs.environment, stdout=writer, stderr=writer
    )
    os.close(writer)
    os.read(reader, 1)
    os.close(reader)
    saved = progress(run)
    wait_for(process, lambda: progress(run) > saved)
    process.send_signal(signal.SIGINT)
    assert process.wait(LIMIT) == 130


def killed_beside_a_second_process(runs, run):
    """The second is refused, and writes nothing; the death of the first frees the folder."""
    saved = progress(run)
    first = runs.start(run)
    wait_for(first, lambda: progress(run) > saved)
    first.send_signal(signal.SIGSTOP)
    try:
        # Its other threads may still be on their way to a halt.
        time.sleep(0.5)
        before = {path: path.stat().st_mtime_ns for path in run.rglob("*")}
        second = runs.start(run)
        _, errors = second.communicate(timeout=LIMIT)
        assert errors == f"run_grid: --out: another process is at work in {run}\n"
        assert second.returncode == 2
        assert {path: path.stat().st_mtime_ns for path in run.rglob("*")} == before
    finally:
        assert killed(first)


def terminated_at(runs, run, steps):
    process = runs.start(run)
    wait_for(process, lambda: progress(run) >= steps)
    process.send_signal(signal.SIGTERM)
    _, errors = process.communicate(timeout=LIMIT)
    assert errors == f"run_grid: stopped by SIGTERM; {CONTINUE}"
    assert process.returncode == 143


def finished_in_part(runs, run):
    """A command for fewer cells shows its own, also where nothing can be printed."""
    command = (*runs.command(run), "--n-demos", "1", "--seeds", "3")
    with open("/dev/full", "w") as full:
        done = subprocess.run(
            command, cwd=ROOT, env=runs.environment, stdout=full, stderr=full, check=False
        )
    assert done.returncode == 0
    rows = pl.read_parquet(run / "seeds.parquet").select("n_demos", "seed").rows()
    assert rows == [(1, seed) for seed in range(3)]


def test_a_run_that_was_killed_and_stopped_is_as_one_that_nothing_befell(runs, whole, tmp_path):
    run = tmp_path / "run"
    killed_between(runs, run, 1, 250)
    terminated_at(runs, run, STEPS + 500)
    assert "hs-me-ddpg-n2-seeds-0-3 goes on from its checkpoint" in runs.finish(run)
    assert_same_run(run, whole)


@pytest.mark.slow
def test_a_run_that_all_of_this_befell_is_as_one_that_nothing_befell(runs, whole, tmp_path):
    run = tmp_path / "run"
    killed_between(runs, run, 1, 250)
    stopped_without_a_reader(runs, run)
    killed_beside_a_second_process(runs, run)
    killed_between(runs, run, 1_000, 1_250)
    terminated_at(runs, run, STEPS + 500)
    finished_in_part(runs, run)
    # The other cell has kept its checkpoint.
    assert "hs-me-ddpg-n2-seeds-0-3 goes on from its checkpoint" in runs.finish(run)
    assert_same_run(run, whole)


def written_since(moment, run, pattern):
    """Whether a path of the run was made or changed after `moment`."""
    for path in paths(run, pattern):
        with contextlib.suppress(FileNotFoundError):
            if path.stat().st_mtime > moment:
                return True
    return False


PHASES = {
    "compiling": ("../compiled-*/*", 4.0),
    "training and evaluating": ("checkpoints/*/[0-9]*", 0.5),
    "saving a checkpoint": ("checkpoints/*/.*.partial", 0.02),
    "saving a cell": ("cells/.*.partial", 0.05),
    "writing tables": (".*.parquet.partial", 0.02),
    "drawing": ("figures/*", 0.2),
}
"""What is written when a phase begins, and seconds that it takes."""
ATTEMPTS = 20
"""Processes within which four must be met in the phase."""


@pytest.mark.slow
@pytest.mark.parametrize("phase", PHASES)
def test_a_run_may_be_killed_in_any_phase(runs, whole, tmp_path, phase):
    """Four times each, at a random moment of the phase."""
    run, kills = tmp_path / "run", 0
    pattern, seconds = PHASES[phase]
    moments = random.Random(phase)
    for number in range(ATTEMPTS):
        fresh = {}
        if phase == "compiling":
            fresh["JAX_COMPILATION_CACHE_DIR"] = str(tmp_path / f"compiled-{number}")
        began = time.time()
        process = runs.start(run, **fresh)
        wait_for(process, lambda began=began: written_since(began, run, pattern))
        time.sleep(moments.uniform(0.0, seconds))
        kills += killed(process)
        # It may have been too late.
        assert process.returncode in (0, -signal.SIGKILL)
        if (run / "summary.csv").exists():
            shutil.rmtree(run)
        if kills == 4:
            break
    assert kills == 4
    runs.finish(run)
    assert_same_run(run, whole)


@pytest.mark.slow
def test_a_run_may_be_killed_among_its_experts(runs, tmp_path):
    without_demos = ("--demos", "None", "--experts.seeds", "8", "--experts.steps", "6000")
    whole, run = tmp_path / "whole", tmp_path / "run"
    runs.finish(whole, *without_demos)
    for saved in (500, 2_000):
        process = runs.start(run, *without_demos)
        wait_for(process, lambda saved=saved: (run / f"checkpoints/experts/{saved}").exists())
        assert killed(process)
    assert "experts goes on from its checkpoint" in runs.finish(run, *without_demos)
    assert_same_run(run, whole)


@pytest.fixture
def again(runs, whole, tmp_path, monkeypatch):
    """The command within this process, on a run that is finished."""
    folder = shutil.copytree(whole, tmp_path / "again")
    monkeypatch.setattr(start, "start", lambda *_: (ALONE, jax.devices()[:1]))
    return lambda: run_grid.main(runs.command(folder)[3:])


def test_a_signal_among_the_figures_ends_a_run_at_once(again, monkeypatch, capfd):
    monkeypatch.setattr(report, "report", lambda *_, **__: signal.raise_signal(signal.SIGINT))
    assert again() == 130
    assert capfd.readouterr() == ("", f"run_grid: stopped at once; {CONTINUE}")


def test_a_signal_before_the_figures_is_obeyed(again, monkeypatch, capfd):
    finished = cells.finished

    def signalled(folder):
        signal.raise_signal(signal.SIGINT)
        return finished(folder)

    monkeypatch.setattr(cells, "finished", signalled)
    assert again() == 130
    assert capfd.readouterr().err == f"run_grid: stopped by SIGINT; {CONTINUE}"


def can_mount():
    if shutil.which("unshare") is None:
        return False
    mount = (*ISOLATED, "mount", "-t", "tmpfs", "none", "/mnt")
    return not subprocess.run(mount, capture_output=True, check=False).returncode


needs_mount = pytest.mark.skipif(not can_mount(), reason="this user may not mount a file system")


@pytest.mark.slow
@needs_mount
def test_a_full_disk_ends_a_run_that_goes_on_once_there_is_room(runs, whole, tmp_path):
    """It fills up in the second cell: checkpoints fail, then the results do."""
    disk = tmp_path / "disk"
    disk.mkdir()
    script = """
        mount -t tmpfs -o size=64m none "$DISK"
        "$@" &
        until ls "$DISK"/run/cells/hs-me-ddpg-n1* && ls "$DISK"/run/checkpoints/*n2*/[0-9]*
        do sleep 0.01; done > /dev/null 2> /dev/null
        dd if=/dev/zero of="$DISK/filler" 2> /dev/null || true
        status=0
        wait $! || status=$?
        echo "status $status"
        rm "$DISK/filler"
        "$@"
        cp -r "$DISK/run" "$COPY"
    """
    filled = runs.start(
        disk / "run",
        prefix=(*ISOLATED, "bash", "-euc", script, "-"),
        DISK=str(disk),
        COPY=str(tmp_path / "copy"),
    )
    output, errors = filled.communicate(timeout=LIMIT)
    assert filled.returncode == 0, errors
    before, after = output.split("status 1\n")
    assert "no checkpoint could be saved" in before
    assert "[2/2] hs-me-ddpg-n2" in before
    # Where the disk fills up under orbax's hands, it complains too.
    lines = errors.splitlines(keepends=True)
    (line,) = [line for line in lines if line.startswith("run_grid: ")]
    assert "No space left on device" in line
    assert line.endswith(CONTINUE)
    assert "[1/1] hs-me-ddpg-n2" in after
    assert "hs-me-ddpg-n2-seeds-0-3 goes on from its checkpoint" in after
    assert_same_run(tmp_path / "copy", whole)


@needs_mount
def test_a_read_only_folder_is_refused(runs, tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    script = 'mount -t tmpfs -o ro none "$1"; shift; exec "$@"'
    refused = runs.start(disk / "run", prefix=(*ISOLATED, "bash", "-euc", script, "-", str(disk)))
    _, errors = refused.communicate(timeout=LIMIT)
    assert errors == (f"run_grid: --out: cannot write to {disk / 'run'} (Read-only file system)\n")
    assert refused.returncode == 2
