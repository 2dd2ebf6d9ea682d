import contextlib
import os
import random
import re
import signal
import socket
import subprocess
import sys
import time

import chex
import polars as pl
import pytest
from polars.testing import assert_frame_equal

from cmedirl_jax.data import demonstrations
from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs.cluster import processes
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import tables
from experiments import run_grid
from tests.support import ROOT, pools

PROCESSES = 2
LIMIT = 300.0
"""Seconds after which a process that should have ended is one that hangs."""
FIRST_CELL = "cells/me-ddpg-n1-seeds-0-8"
TINY = (
    # Two cells that share their programs.
    *("--methods", "me-ddpg", "--n-demos", 1, 2, "--seeds", 9, "--max-steps", 300),
    *("--architecture.hidden", 8, "--reward-network.hidden", 8, "--schedule.batch-size", 8),
    *("--schedule.learning-starts", 10, "--reward-batches.batch-size", 8),
    *("--checkpoint-every", 0),
)
# Gloo's threads write the parts of a line one by one, and so between one another.
GLOO = re.compile(
    r"\[Gloo\] Rank | is connected to | peer ranks\. |"
    r"Expected number of connected peer ranks is : |\d+|\n"
)


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("--processes 2", "--processes: needs --coordinator HOST:PORT"),
        ("--process-id 1", "--process-id: needs --coordinator HOST:PORT"),
        ("--coordinator here:1", "--coordinator: needs --processes N and --process-id I too"),
        ("--coordinator here", "--coordinator: must be HOST:PORT, got here"),
        ("--coordinator :80", "--coordinator: must be HOST:PORT, got :80"),
        ("--coordinator here:65536", "--coordinator: must be HOST:PORT, got here:65536"),
        (
            "--coordinator here:1 --processes 0 --process-id 0",
            "--processes: must be at least 1, got 0",
        ),
        (
            "--coordinator here:1 --processes 2 --process-id 2",
            "--process-id: must be between 0 and 1, got 2",
        ),
        (
            "--coordinator here:1 --processes 2 --process-id -1",
            "--process-id: must be between 0 and 1, got -1",
        ),
    ],
)
def test_options_that_contradict_each_other_are_refused(capsys, arguments, line):
    assert run_grid.main(arguments.split()) == 2
    assert capsys.readouterr().err == f"run_grid: {line}\n"


def test_a_port_is_free_again_at_once_when_a_run_has_ended():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        with socket.create_connection(("127.0.0.1", port)):
            connection, _ = listener.accept()
            # Whoever closes first keeps the port for a while, in TIME_WAIT.
            connection.close()
    processes._check_port(port)


@pytest.mark.parametrize("host", ["127.0.0.1", "0.0.0.0"])
def test_a_port_that_is_taken_is_refused(host):
    with socket.create_server((host, 0)) as listener:
        port = listener.getsockname()[1]
        with pytest.raises(UserError, match=f"^--coordinator: port {port} is in use$"):
            processes._check_port(port)


def test_a_command_whose_port_is_taken_is_refused(unoptimised, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
        options = (
            *("--coordinator", f"127.0.0.1:{port}", "--processes", PROCESSES, "--process-id", 0),
            *("--devices", 1, "--out", tmp_path / "run"),
        )
        with Processes(tmp_path, lambda _: unoptimised, lambda _: options, count=1) as run:
            assert run.codes() == [2]
            assert run.output(0) == f"run_grid: --coordinator: port {port} is in use\n"


def free_port():
    """A free port below those that systems give to connections, which come and go meanwhile."""
    for port in random.sample(range(15_000, 30_000), 100):
        with contextlib.suppress(UserError):
            processes._check_port(port)
            return port
    raise AssertionError("no port is free")


class Processes:
    """The processes of one run, each with its output in a file; ended at exit, come what may."""

    def __init__(self, folder, environment, options, count=PROCESSES):
        # Whoever reads pipes one after the other can keep a process waiting.
        self.outputs = [folder / f"output-{index}" for index in range(count)]
        self.running = []
        for index, output in enumerate(self.outputs):
            command = [*(sys.executable, "-m", "experiments.run_grid"), *options(index)]
            with output.open("w") as file:
                self.running.append(
                    subprocess.Popen(
                        [str(part) for part in command],
                        cwd=ROOT,
                        env=os.environ | environment(index),
                        stdin=subprocess.DEVNULL,
                        stdout=file,
                        stderr=subprocess.STDOUT,
                    )
                )

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in self.running:
            process.kill()
            process.wait()

    def codes(self):
        """Exit codes of all, once they have ended."""
        until = time.monotonic() + LIMIT
        return [process.wait(max(until - time.monotonic(), 0.1)) for process in self.running]

    def output(self, index):
        return self.outputs[index].read_text()


@pytest.fixture(scope="module")
def demos(tmp_path_factory):
    path = tmp_path_factory.mktemp("demos") / "demos.npz"
    demonstrations.save(path, pools.scripted(3))
    return path


@pytest.fixture
def together(tmp_path, unoptimised, demos):
    """A function that starts two processes of two devices, each with a folder of its own."""

    def start():
        port = free_port()

        def of_process(index):
            return (
                *(*TINY, "--devices", 2, "--demos", demos, "--out", tmp_path / f"run-{index}"),
                *("--coordinator", f"127.0.0.1:{port}", "--processes", PROCESSES),
                *("--process-id", index),
            )

        return Processes(tmp_path, lambda _: unoptimised, of_process)

    return start


@pytest.fixture(scope="module")
def alone(tmp_path_factory, unoptimised, demos):
    """The folder of the same run on one process with one device."""
    folder = tmp_path_factory.mktemp("alone") / "run"
    command = ("-m", "experiments.run_grid", *TINY, "--demos", demos, "--devices", 1)
    done = subprocess.run(
        [sys.executable, *map(str, command), "--out", str(folder)],
        cwd=ROOT,
        env=os.environ | unoptimised,
        capture_output=True,
        text=True,
        check=False,
        timeout=LIMIT,
    )
    assert done.returncode == 0, done.stderr
    return folder


def wait_for(run, condition):
    until = time.monotonic() + LIMIT
    while not condition():
        assert time.monotonic() < until
        assert all(process.poll() is None for process in run.running), run.output(0)
        time.sleep(0.02)


def assert_same_tables(folder, expected):
    for name in tables.FILES:
        found, wanted = (pl.read_parquet(path / name) for path in (folder, expected))
        assert_frame_equal(found, wanted, rel_tol=1e-3, abs_tol=1e-3)


@pytest.mark.slow
def test_stopped_together_or_bereaved_they_go_on_to_what_one_process_gives(
    together, alone, tmp_path
):
    folder = tmp_path / "run-0"
    with together() as run:
        wait_for(run, lambda: "[1/2] me-ddpg-n1" in run.output(0))
        # One is told to stop, all do, where they can go on from.
        run.running[1].send_signal(signal.SIGTERM)
        assert run.codes() == [143, 143], run.output(0) + run.output(1)
        for index in range(PROCESSES):
            assert "run_grid: stopped by SIGTERM" in run.output(index).splitlines()[-1]

    with together() as run:
        wait_for(run, (folder / FIRST_CELL).exists)
        assert "me-ddpg-n1-seeds-0-8 goes on from its checkpoint" in run.output(0)
        # The first cell is finished; it dies in the second.
        run.running[1].kill()
        assert run.codes() == [1, -signal.SIGKILL]
        assert run.output(0).splitlines()[-1] == f"run_grid: {processes.GONE}"
        assert "Traceback" not in run.output(0)
    assert not (folder / "summary.csv").exists()

    with together() as run:
        assert run.codes() == [0, 0], run.output(0) + run.output(1)
        assert "9 seeds per cell on 4 CPU device(s)" in run.output(0)
        assert "[1/1] me-ddpg-n2" in run.output(0)
        assert GLOO.sub("", run.output(1)) == ""
    assert not (tmp_path / "run-1").exists()
    assert_same_tables(folder, alone)
    found, wanted = (checkpoint.load(path / FIRST_CELL / "policies") for path in (folder, alone))
    chex.assert_trees_all_close(found, wanted, rtol=1e-3, atol=1e-3)


def test_the_death_of_the_writer_ends_the_others_too(together):
    with together() as run:
        wait_for(run, lambda: "[1/2] me-ddpg-n1" in run.output(0))
        run.running[0].kill()
        assert run.codes() == [-signal.SIGKILL, 1]
        assert f"run_grid: {processes.GONE}" in run.output(1).splitlines(), run.output(1)


def test_processes_that_a_cluster_starts_find_each_other_and_refuse_together(unoptimised, tmp_path):
    cluster = {
        "SLURM_JOB_ID": "1",
        "SLURM_STEP_NODELIST": "127.0.0.1",
        "SLURM_NTASKS": str(PROCESSES),
        "JAX_COORDINATOR_PORT": str(free_port()),
    }

    def environment(index):
        return unoptimised | cluster | {"SLURM_PROCID": str(index), "SLURM_LOCALID": str(index)}

    def options(index):
        return ("--distributed", "--devices", 1, "--seeds", 5 + index, "--out", tmp_path / "run")

    with Processes(tmp_path, environment, options) as run:
        assert run.codes() == [2, 2]
        for index, differ in enumerate(("another process", "seeds")):
            assert run.output(index).splitlines()[-1] == (
                f"run_grid: --process-id: not all processes were given the same options ({differ})"
            )
    assert not (tmp_path / "run").exists()


def test_a_folder_that_cannot_be_written_is_refused_on_all(unoptimised, tmp_path):
    port = free_port()
    (tmp_path / "file").touch()

    def options(index):
        return (
            *("--coordinator", f"127.0.0.1:{port}", "--processes", PROCESSES),
            *("--process-id", index, "--devices", 1, "--seeds", 9, "--out", tmp_path / "file/run"),
        )

    with Processes(tmp_path, lambda _: unoptimised, options) as run:
        assert run.codes() == [2, 2]
        for index in range(PROCESSES):
            line = run.output(index).splitlines()[-1]
            assert line.startswith("run_grid: --out: cannot write to ")


def test_without_a_cluster_there_is_nothing_to_join(tmp_path):
    options = ("--distributed", "--devices", 1)
    with Processes(tmp_path, lambda _: {}, lambda _: options, count=1) as run:
        assert run.codes() == [2]
        (line,) = run.output(0).splitlines()
        assert line.startswith("run_grid: --distributed: JAX detects no cluster here (")
