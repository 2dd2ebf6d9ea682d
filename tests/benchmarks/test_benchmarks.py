import dataclasses
import functools
import json
import os
import subprocess
import sys
import time
import types
from pathlib import Path

import numpy as np
import polars as pl
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks import (
    checkpoint_cost,
    coverage,
    gymnasium_tasks,
    host_tasks,
    main_job,
    measuring,
    naive,
    ours,
    peers,
    plots,
    scaling,
    seeds_per_second,
)
from benchmarks.measuring import Record
from benchmarks.peers import PEERS
from benchmarks.serving import Worker
from benchmarks.workload import Workload
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.console import phases
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import checkpoints
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.training.methods import PAPER_METHODS
from cmedirl_jax.training.settings import Settings
from experiments import run_grid
from tests.support import pools, trainers

TINY = {"seeds": 3, "hidden": (4,), "batch": 4}
DESIGNED = {
    *("variant", "method", "seeds", "width", "batch", "layer_norm", "devices"),
    *("learning_steps_per_second", "seeds_per_second", "compile_seconds", "peak_memory_bytes"),
}
LOOP = """
import sys, time
from benchmarks.serving import serve
print("said by a library")
serve(lambda steps: time.sleep(steps / 1000), int(sys.argv[-1]), lambda: {"answer": 42})
"""


@pytest.fixture
def worker():
    made = Worker([sys.executable, "-c", LOOP, "20"], measuring.one_core())
    yield made
    made.stop()


def test_a_worker_times_its_loop_and_nothing_else(worker):
    assert worker.facts["answer"] == 42
    assert worker.facts["first_call_seconds"] >= 0.02
    for steps in (10, 50):
        assert steps / 1000 <= worker.seconds(steps) < steps / 1000 + 0.5
    if worker.peak_memory_bytes is not None:
        assert 1e6 < worker.peak_memory_bytes < 1e9


@pytest.mark.skipif(not hasattr(os, "sched_getaffinity"), reason="processes cannot be pinned here")
def test_a_worker_runs_on_its_core_alone():
    code = LOOP.replace('"answer": 42', '"cores": sorted(__import__("os").sched_getaffinity(0))')
    (core,) = measuring.one_core()
    worker = Worker([sys.executable, "-c", code, "1"], [core])
    assert worker.facts["cores"] == [core]
    worker.stop()


def test_a_worker_that_fails_says_why():
    broken = Worker([sys.executable, "-c", "raise SystemExit('no such thing')"], None)
    with pytest.raises(RuntimeError, match="no such thing"):
        broken.facts  # noqa: B018
    broken.stop()


class FakeWorker:
    """Takes a second a step, and twice that from its second call on."""

    def __init__(self, name, calls, seconds=1.0):
        self.name, self.calls, self.each = name, calls, seconds
        self.facts = {"compile_seconds": 3.0, "platform": "cpu"}
        self.peak_memory_bytes = 10**9
        self.stopped = False

    def seconds(self, steps):
        self.calls.append(self.name)
        return steps * self.each * (1 + (self.calls.count(self.name) > 1))

    def wait(self):
        assert not self.stopped

    def stop(self):
        self.stopped = True


def test_workers_are_timed_in_turn():
    calls = []
    workers = [(FakeWorker("a", calls), 10, 100.0), (FakeWorker("b", calls, 0.5), 20, 40.0)]
    assert measuring.in_turn(workers, 3) == [[10.0, 5.0, 5.0], [4.0, 2.0, 2.0]]
    assert calls == ["a", "b"] * 3


rates = st.lists(st.floats(1e-3, 1e6), min_size=1, max_size=9)


@given(rates, st.floats(1e-3, 1e3), st.randoms())
def test_a_ratio_does_not_notice_a_machine_whose_speed_drifts(speeds, ratio, random):
    below = [speed * random.uniform(0.5, 2.0) for speed in speeds]
    ratio_of_rates = measuring.compare("suite", "name", [ratio * rate for rate in below], below)
    measured = [ratio_of_rates.median, ratio_of_rates.low, ratio_of_rates.high]
    np.testing.assert_allclose(measured, ratio, rtol=1e-6)


@pytest.mark.parametrize("method", ["ddpg", "hs-me-ddpg"])
def test_a_plain_workload_advances_all_its_seeds(method):
    advance = naive.start(Workload(method=method, n_demos=2, **TINY), pools.scripted())
    advance(5)
    advance(5)


def test_every_timed_step_of_ours_learns(monkeypatch):
    logs = []
    compile_method = compiled_lib.compile_method

    def compile_and_listen(*args, **kwargs):
        compiled = compile_method(*args, **kwargs)

        def run(*args):
            state, log = compiled.run(*args)
            logs.append(log)
            return state, log

        return compiled._replace(run=run)

    monkeypatch.setattr(compiled_lib, "compile_method", compile_and_listen)
    advance = ours.start(Workload(**TINY), pools.scripted())
    advance(5)
    advance(5)
    assert np.all([log.learned for log in logs])
    losses = np.concatenate([log.critic_loss for log in logs], axis=1)
    assert losses.shape == (3, 10)
    assert np.all(losses[:, 1:] > 0.0)


def test_a_workload_can_leave_out_seeds_that_have_ended():
    demonstrated = {"method": "hs-me-ddpg", "n_demos": 2}
    advance = ours.start(Workload(running=0.34, group=1, **demonstrated, **TINY), pools.scripted())
    advance(5)
    advance(5)


@pytest.fixture
def fake_start(monkeypatch):
    """Workloads that run in no process; returns those that were asked for."""
    started = []

    def start(workload, steps, **environment):
        started.append((workload, environment))
        naive = workload.variant == "naive"
        return FakeWorker(len(started), [], (2.0 if naive else 1.0) * workload.seeds / 100)

    monkeypatch.setattr(measuring, "start", start)
    monkeypatch.setattr(measuring, "cores", lambda: 2)
    return started


@pytest.mark.parametrize("quick", [True, False])
def test_seeds_per_second_writes_what_the_design_lists(
    fake_start, monkeypatch, tmp_path, quick, capsys
):
    path = tmp_path / "new" / "speed.json"
    # It draws after each suite; here the last figure alone, of all that was measured.
    drawn, draw = [], plots.growth
    monkeypatch.setattr(plots, "growth", lambda *args: drawn.append(args))
    options = seeds_per_second.Options(quick=quick, json=path)
    assert seeds_per_second.main(options) == 0
    written = json.loads(path.read_text())
    assert {"machine", "versions", "records", "command", "date"} <= written.keys()
    assert all(record.keys() >= DESIGNED for record in written["records"])
    draw(*drawn[-1])
    assert path.with_suffix(".png").stat().st_size
    name = "ours / naive" if quick else "ours / naive, ddpg, 100 seeds"
    (ratio,) = (entry for entry in written["comparisons"] if entry["name"] == name)
    assert ratio["median"] == ratio["low"] == ratio["high"] == 2.0
    assert f"{name}: 2.00" in capsys.readouterr().out
    measured = {(record["method"], record["seeds"]) for record in written["records"]}
    if quick:
        assert measured == {("ddpg", 100)}
    else:
        methods, sizes = PAPER_METHODS, seeds_per_second.SEEDS
        assert measured >= {(method, seeds) for method in methods for seeds in sizes}
        assert len(written["compilation"]) == 2 * len(methods)


def test_only_the_suites_asked_for_are_measured(fake_start, tmp_path):
    path = tmp_path / "speed.json"
    seeds_per_second.main(seeds_per_second.Options(suites=("scale",), json=path))
    assert [workload.seeds for workload, _ in fake_start] == [*seeds_per_second.SCALE]
    assert json.loads(path.read_text())["compilation"] == []


def test_only_the_methods_asked_for_are_measured(fake_start):
    options = seeds_per_second.Options(suites=("seeds", "method"), methods=("me-ddpg",))
    assert seeds_per_second.main(options) == 0
    seeds_suite = [workload.method for workload, _ in fake_start[: 2 * len(seeds_per_second.SEEDS)]]
    assert set(seeds_suite) == {"me-ddpg"}
    assert [workload.method for workload, _ in fake_start[-3:]] == ["ddpg", "me-ddpg", "ddpg"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"suites": ("sizes",)}, "--suites: unknown suite 'sizes'; there are seeds, "),
        ({"methods": ("sac",)}, "--methods: unknown method 'sac'; there are ddpg, "),
    ],
)
def test_unknown_suites_and_methods_are_refused(fake_start, capsys, options, message):
    assert seeds_per_second.main(seeds_per_second.Options(**options)) == 2
    assert capsys.readouterr().err.startswith(f"seeds_per_second: {message}")


def test_a_files_command_names_no_path_of_this_machine(monkeypatch):
    given = ["--cells", "3", "--json", "/a/b c/one.json", "--out=/d/two.json", "docs/x.json"]
    monkeypatch.setattr(sys, "argv", ["soak.py", *given])
    command = measuring.heading("soak")["command"]
    shown = "--cells 3 --json one.json --out=two.json docs/x.json"
    assert command == f"python -m benchmarks.soak {shown}"


def test_a_record_is_summed_up_by_its_median():
    record = Record(Workload(), [3.0, 12_000.0, 24_000.0], 5.0, None, "cpu").fields()
    assert record["learning_steps_per_second"] == 12_000.0
    assert record["seeds_per_second"] == 1.0
    assert record["learning_steps_per_second_best"] == 24_000.0
    assert record["learning_steps_per_second_worst"] == 3.0


def test_a_peer_that_cannot_be_installed_is_named(fake_start, monkeypatch, tmp_path, capsys):
    def environment(name, requirements, folder):
        if name == "rejax_td3":
            raise RuntimeError("there is no such version")
        return Path("python")

    workers = []

    def make(command, cores):
        workers.append(FakeWorker(command[2], [], 0.01))
        return workers[-1]

    monkeypatch.setattr(peers, "environment", environment)
    monkeypatch.setattr(peers, "versions", lambda python: {"jax": "1"})
    monkeypatch.setattr(peers, "Worker", make)
    path = tmp_path / "peers.json"
    assert peers.main(peers.Options(environments=tmp_path, json=path)) == 0
    entries = {entry["module"]: entry for entry in json.loads(path.read_text())["peers"]}
    assert entries.keys() == {peer.module for peer in PEERS}
    assert entries["rejax_td3"]["error"] == "there is no such version"
    # Ours takes a hundred steps a second, a peer of one seed a hundredth of a second for each.
    assert entries["sb3_ddpg"]["ratio"]["median"] == pytest.approx(1.0)
    printed = capsys.readouterr().out
    assert "not installed" in printed
    assert "there is no such version" in printed
    assert all(worker.stopped for worker in workers)


def test_a_peers_environment_is_made_once_and_again_for_other_requirements(tmp_path, monkeypatch):
    commands = []

    def run(command, **_):
        commands.append(list(map(str, command)))
        if "venv" in commands[-1]:
            Path(commands[-1][-1]).mkdir(exist_ok=True)
        return subprocess.CompletedProcess(command, 0, "", "")

    monkeypatch.setattr(peers.subprocess, "run", run)
    python = peers.environment("peer", ("this", "that==1"), tmp_path)
    assert python.is_relative_to(tmp_path / "peer")
    assert [command[2] for command in commands] == ["venv", "pip"]
    assert commands[1][-2:] == ["this", "that==1"]
    assert peers.environment("peer", ("this", "that==1"), tmp_path) == python
    assert len(commands) == 2
    peers.environment("peer", ("other",), tmp_path)
    assert len(commands) == 4


def test_an_environment_that_was_half_cleared_is_made_again(tmp_path, monkeypatch):
    (tmp_path / "peer").mkdir()
    (tmp_path / "peer" / "requirements.txt").write_text("this")

    def stop(command, **_):
        raise KeyboardInterrupt

    monkeypatch.setattr(peers.subprocess, "run", stop)
    for requirements in (("other",), ("this",)):
        with pytest.raises(KeyboardInterrupt):
            peers.environment("peer", requirements, tmp_path)


def test_an_installation_that_fails_is_not_taken_for_done(tmp_path, monkeypatch):
    def run(command, **_):
        if "venv" in command:
            Path(command[-1]).mkdir()
        return subprocess.CompletedProcess(command, int("pip" in command), "", "no matching thing")

    monkeypatch.setattr(peers.subprocess, "run", run)
    with pytest.raises(RuntimeError, match="no matching thing"):
        peers.environment("peer", ("this",), tmp_path)
    assert not (tmp_path / "peer" / "requirements.txt").exists()


@pytest.mark.parametrize("peer", PEERS, ids=lambda peer: peer.module)
def test_every_peer_has_its_loop(peer):
    loops = Path(peers.__file__).with_name("peer_loops")
    assert (loops / f"{peer.module}.py").exists()
    assert "serve_from_command_line(" in (loops / f"{peer.module}.py").read_text()


def test_workloads_are_plain_data():
    workload = Workload(method="me-ddpg", hidden=(400, 300))
    options = json.loads(json.dumps(dataclasses.asdict(workload)))
    assert Workload(**{**options, "hidden": tuple(options["hidden"])}) == workload


def test_a_process_of_the_scaling_benchmark_times_its_turns(monkeypatch):
    monkeypatch.setenv("JAX_DISABLE_MOST_OPTIMIZATIONS", "1")
    job = {"method": "ddpg", "seeds_count": 1, "devices": 1, "coordinator": "", "processes": 1}
    worker = scaling.start(job | {"index": 0})
    try:
        times = scaling.turn([worker])
    finally:
        worker.kill()
        worker.communicate()
    assert times["chunk_s"] > 0.0
    assert times["gather_bytes"] == 5_000


@pytest.fixture
def fake_training(monkeypatch):
    """A cell of ten chunks, a hundredth of a second each by the clock that says what is due."""
    weight = np.random.default_rng(0).random(1_000)
    clock = types.SimpleNamespace(now=0.0)
    fake_time = types.SimpleNamespace(
        monotonic=lambda: clock.now, perf_counter=time.perf_counter, sleep=time.sleep
    )
    for module in (checkpoint_cost, checkpoints):
        monkeypatch.setattr(module, "time", fake_time)

    def train(*_, checkpointer, **__):
        for step in range(10):
            time.sleep(0.01)
            clock.now += 0.01
            if checkpointer is not None:
                checkpointer.save_if_due(step, lambda: ({"weight": weight}, {"step": np.ones(1)}))

    monkeypatch.setattr(checkpoint_cost.cell_lib, "train", train)


def test_checkpoints_are_counted_and_their_cost_is_of_the_time_without(fake_training):
    options = checkpoint_cost.Options(every=0.025, rounds=3)
    costs = checkpoint_cost.measure(options, compiled=None)
    assert costs["checkpoints"] == 3 * 4
    assert 8_000 <= costs["checkpoint_bytes"] < 20_000
    assert costs["cost_low"] <= costs["cost"] <= costs["cost_high"]
    assert costs["cost_by_default"] == pytest.approx(costs["cost"] * 0.025 / 60)
    assert costs["blocked_seconds"] > 0.0


def test_a_run_too_short_for_a_checkpoint_says_so(fake_training):
    with pytest.raises(UserError, match=r"--every: none was due .* ask for more --steps"):
        checkpoint_cost.measure(checkpoint_cost.Options(every=60.0), compiled=None)


def test_the_main_jobs_learning_steps_are_those_of_all_its_seeds_and_experts(tmp_path):
    pl.DataFrame({"env_steps": [12_000, 900, 0]}).write_parquet(tmp_path / "seeds.parquet")
    assert main_job.learning_steps(tmp_path, trains_experts=True) == 12_900
    metadata = {"env": "MountainCarContinuous-v0", "expert_env_steps": 7_000}
    pool = pools.random_pool([3, 2])._replace(metadata=metadata)
    stored_demonstrations.save(tmp_path, pool)
    assert main_job.learning_steps(tmp_path, trains_experts=True) == 19_900
    # A file of demonstrations tells of its experts, who are not trained again.
    assert main_job.learning_steps(tmp_path, trains_experts=False) == 12_900


def test_a_yardsticks_last_rate_counts():
    command = f"{sys.executable} -c \"print('4 steps/s'); print('x: 31500.5 steps/s (32 us)')\""
    assert main_job.yardstick_rate(command) == 31500.5
    assert main_job.yardstick_rate(None) is None


@pytest.mark.parametrize("command", ["true", "/no/such/program"])
def test_a_yardstick_without_a_rate_is_refused(command):
    with pytest.raises(UserError, match=f"--yardstick: {command} prints no steps/s"):
        main_job.yardstick_rate(command)


CHILD = """
import json, os, pathlib, sys
import polars as pl
from cmedirl_jax.runs.storage import demonstrations
from tests.support import pools
assert sys.argv[2:5] == ["--seeds", "3", "--out"] and len(sys.argv) == 6, sys.argv
pathlib.Path(sys.argv[5]).mkdir()
metadata = {"env": "MountainCarContinuous-v0", "expert_env_steps": 3 * 14_000}
pool = pools.random_pool([3])._replace(metadata=metadata)
folder = pathlib.Path(sys.argv[5])
demonstrations.save(folder, pool)
pl.DataFrame({"env_steps": [12_000] * 12}).write_parquet(folder / "seeds.parquet")
cache = pathlib.Path(os.environ["JAX_COMPILATION_CACHE_DIR"])
warm = (cache / "entry").exists()
(cache / "entry").touch()
spent = {"training": 0.02, "compilation": 0.001 if warm else 0.003}
measured = {"phases": spent, "peak_memory_bytes": 2_000_000}
pathlib.Path(sys.argv[1]).write_text(json.dumps(measured))
"""


@pytest.mark.slow
def test_the_main_job_runs_cold_and_warm(monkeypatch, tmp_path, capsys):
    monkeypatch.setattr(main_job, "_CHILD", CHILD)
    yardstick = f"{sys.executable} -c \"print('1000 steps/s')\""
    options = ["--rounds", "2", "--job=--seeds 3", "--yardstick", yardstick]
    assert main_job.main([*options, "--json", str(tmp_path / "job.json")]) == 0
    result = json.loads((tmp_path / "job.json").read_text())
    steps = 4 * 3 * 12_000 + 3 * 14_000
    for kind, compilation in (("cold", 0.003), ("warm", 0.001)):
        assert len(result["runs"][kind]) == 2
        for run in result["runs"][kind]:
            assert run["learning_steps"] == steps
            assert run["phases"]["compilation"] == compilation
            assert run["peak_memory_bytes"] == 2_000_000
            assert run["seconds"] == pytest.approx(sum(run["phases"].values()))
            assert run["training_steps_per_second"] == steps / 0.02
            assert run["seconds_by_yardstick"] == pytest.approx(run["seconds"] * 1000 / steps)
    printed = capsys.readouterr().out
    assert "T R / N" in printed
    assert "compilation" in printed


def test_a_main_job_that_fails_says_why(monkeypatch, capsys):
    monkeypatch.setattr(main_job, "_CHILD", "import sys; sys.exit('no such option')")
    assert main_job.main([]) == 2
    assert "main_job: --job: the run failed: no such option" in capsys.readouterr().err


def test_the_main_jobs_process_writes_its_phases(monkeypatch, tmp_path):
    def run(job):
        assert job == ["--seeds", "3"]
        with phases.phase("training"):
            time.sleep(0.01)
        return 0

    monkeypatch.setattr(run_grid, "main", run)
    monkeypatch.setattr(sys, "argv", ["-c", str(tmp_path / "answer"), "--seeds", "3"])
    with pytest.raises(SystemExit, match="0"):
        main_job.work()
    written = json.loads((tmp_path / "answer").read_text())
    assert written["phases"]["training"] >= 0.01
    assert written["phases"]["compilation"] == 0.0
    if written["peak_memory_bytes"] is not None:
        assert written["peak_memory_bytes"] > 1e6


def test_what_is_used_is_right_at_about_the_promised_rate(tmp_path, monkeypatch):
    # As many as tell 5% apart.
    monkeypatch.setattr(coverage.paired, "FLIPS", 999)
    monkeypatch.setattr(coverage.intervals, "RESAMPLES", 500)
    out = tmp_path / "coverage.csv"
    assert coverage.main(["--trials", "30", "--out", str(out)]) == 0
    used = pl.read_csv(out).filter(pl.col("used") & (pl.col("samples") == 30))
    intervals, tests = (used.filter(pl.col("nominal") == rate)["measured"] for rate in (0.95, 0.05))
    assert intervals.min() >= 0.8
    assert tests.max() <= 0.2
    assert used.height > 15


def small_networks(training, monkeypatch):
    """Trainers of default settings are small ones."""
    starts = Settings().schedule.learning_starts
    settings = trainers.with_(architecture={"hidden": (4,)}, schedule={"learning_starts": starts})
    make = functools.partial(training.make, settings=settings)
    monkeypatch.setattr(training, "make", make)


def test_vectors_and_learners_of_gymnasiums_tasks_are_timed_in_turn(tmp_path, monkeypatch):
    small_networks(gymnasium_tasks.training, monkeypatch)
    monkeypatch.setattr(gymnasium_tasks, "CHUNK", 2)
    monkeypatch.setattr(gymnasium_tasks, "TASKS", gymnasium_tasks.TASKS[:2])
    out = tmp_path / "rates.json"
    few = ["--count", "3", "--steps", "2", "--seeds", "2", "--rounds", "2", "--out", str(out)]
    assert gymnasium_tasks.main(few) == 0
    written = json.loads(out.read_text())
    assert [row["what"].rpartition(" ")[2] for row in written["rows"]] == [
        *gymnasium_tasks.VECTORS,
        *gymnasium_tasks.VECTORS,
        *gymnasium_tasks.TASKS,
    ]
    for row in written["rows"]:
        assert len(row["rounds"]) == 2
        assert min(row["rounds"]) > 0.0
    for name, gain in written["gains"].items():
        ours, theirs = (
            next(row for row in written["rows"] if row["what"] == f"{kind} {name}")["rounds"]
            for kind in ("to_gymnasium_vector", "SyncVectorEnv")
        )
        ratios = sorted(x / y for x, y in zip(ours, theirs, strict=True))
        assert ratios[0] <= gain <= ratios[-1]


def test_the_phases_and_rates_of_a_task_on_the_host_are_measured(tmp_path, monkeypatch, capsys):
    # Three more programs to compile; the command's own tests train in the same way.
    monkeypatch.setattr(host_tasks, "trainer", lambda *_, **__: lambda: None)
    small_networks(host_tasks.training, monkeypatch)
    learned, run = [], host_tasks.host_loop.run

    def noted(*arguments):
        states, log = run(*arguments)
        learned.append(log.learned.mean())
        return states, log

    monkeypatch.setattr(host_tasks.host_loop, "run", noted)
    out = tmp_path / "host.json"
    # As many steps as an episode has, so that one begins.
    few = ["--steps", "60", "--seeds", "2", "--rounds", "2", "--out", str(out)]
    assert host_tasks.main(["--tasks", "tests.support.host_tasks:Dock-v0", *few]) == 0
    (entry,) = json.loads(out.read_text())["tasks"]
    assert set(entry["microseconds"]) == {"simulator", "resets", "updates", "without updates"}
    # The first episodes, the calls without updates, and those with them.
    assert learned == [1.0, 0.0, 1.0]
    assert all(0.0 < spent < 1e6 for spent in entry["microseconds"].values())
    assert len(entry["rates"]) == 3
    assert all(len(rates) == 2 and min(rates) > 0.0 for rates in entry["rates"].values())
    assert "Dock-v0" in capsys.readouterr().out
