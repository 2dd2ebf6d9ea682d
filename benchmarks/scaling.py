"""`python -m benchmarks.scaling`: the same seeds on one process and on two, chunk by chunk.

Three arrangements take turns: one process with two devices, two processes with one device each over
loopback, and one process with one device and half of the seeds, which is one device's share. The
communication after every chunk is timed by itself.
"""

import dataclasses
import functools
import json
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from benchmarks import measuring, ours
from cmedirl_jax.runs.cells import cell as cell_lib
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cells.slots import Slots
from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.cluster.together import Together
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.storage import outputs
from cmedirl_jax.training import seeds
from cmedirl_jax.training.settings import Settings

GROUPS = {"1 process x 2 devices": (1, 2), "2 processes x 1 device": (2, 1), "its share": (1, 1)}
"""Of each arrangement: how many processes, and how many devices each of them has."""
PAIR = list(GROUPS)[:2]
"""The two arrangements with all seeds, which are compared."""
WORKER = "--worker"
"""The first argument of a process that is measured."""
EXTRA_FLOATS = (2**12, 2**14, 2**16)
"""Floats per seed of further arrays that are gathered, to tell latency from bandwidth."""


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure, and where to write it.

    Attributes:
        method: A method that uses no demonstrations.
        seeds: Seeds that an arrangement trains (the last one half of them).
        rounds: Turns of each arrangement.
        json: File for the measurements.
    """

    method: str = "ddpg"
    seeds: int = 100
    rounds: int = 7
    json: Path | None = None


@ending.in_a_line("scaling")
def main(arguments: Sequence[str] | None = None) -> int:
    """Measure, or be one of the processes that are measured; returns the exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    if arguments[:1] == [WORKER]:
        work(**json.loads(arguments[1]))
        return 0
    options = tyro.cli(
        Options, prog="python -m benchmarks.scaling", description=__doc__, args=arguments
    )
    outputs.check("json", options.json)
    measured = measure(options.method, options.seeds, options.rounds)
    one, two = ([turn["chunk_s"] + turn["gather_s"] for turn in measured[name]] for name in PAIR)
    ratios = sorted(a / b for a, b in zip(one, two, strict=True))
    median = statistics.median(ratios)
    if options.json is not None:
        result = measuring.heading("scaling") | {
            "method": options.method,
            "seeds": options.seeds,
            "two_processes_rate_over_one": [median, ratios[0], ratios[-1]],
            "medians": {name: medians(turns) for name, turns in measured.items()},
            "rounds": measured,
        }
        measuring.write(result, options.json)
    say = functools.partial(screen.say, screen.console())
    say(f"Two processes have {median:.2f} ({ratios[0]:.2f} to {ratios[-1]:.2f}) times the rate")
    for name, turns in measured.items():
        seconds = {key: f"{value:.4g}" for key, value in medians(turns).items()}
        say(f"{name}: {seconds}")
    return 0


def measure(method: str, seeds_count: int, rounds: int) -> dict[str, list[dict[str, float]]]:
    """Let the arrangements take turns; each one's times, in seconds, round by round."""
    started = {}
    for name, (processes, devices) in GROUPS.items():
        with socket.socket() as listener:
            listener.bind(("127.0.0.1", 0))
            port = listener.getsockname()[1]
        share = seeds_count if processes * devices > 1 else seeds_count // 2
        job = {"method": method, "seeds_count": share, "devices": devices}
        job |= {"coordinator": f"127.0.0.1:{port}", "processes": processes}
        started[name] = [start(job | {"index": index}) for index in range(processes)]
    try:
        times = [{name: turn(workers) for name, workers in started.items()} for _ in range(rounds)]
    finally:
        for worker in (worker for workers in started.values() for worker in workers):
            worker.kill()
    return {name: [turns[name] for turns in times] for name in started}


def start(job: dict[str, Any]) -> subprocess.Popen:
    """Start a process that is measured."""
    command = [sys.executable, "-m", "benchmarks.scaling", WORKER, json.dumps(job)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def turn(workers: list[subprocess.Popen]) -> dict[str, float]:
    """Let an arrangement train a chunk; the times that its first process measured."""
    for worker in workers:
        assert worker.stdin is not None
        worker.stdin.write("go\n")
        worker.stdin.flush()
    # The answer is JSON; the transport of the collectives prints lines of its own.
    lines = [
        next(line for line in worker.stdout or () if line.startswith("{")) for worker in workers
    ]
    return json.loads(lines[0])


def medians(turns: list[dict[str, float]]) -> dict[str, float]:
    """The median over the turns of every quantity."""
    return {name: statistics.median(turn[name] for turn in turns) for name in turns[0]}


def work(
    method: str, seeds_count: int, devices: int, coordinator: str, processes: int, index: int
) -> None:
    """Train a chunk whenever a line comes, and print how long that took, as JSON."""
    jax.config.update("jax_num_cpu_devices", devices)
    cluster: Cluster = ALONE
    if processes > 1:
        jax.distributed.initialize(coordinator, processes, index)
        cluster = Together()
    spread_over = cluster.devices(devices, seeds_count)

    # The seeds as a run of many seeds has them.
    programs = ours.compile_programs(method, Settings(), spread_over, seeds_count=seeds_count)
    slots = Slots(programs.slots, seeds_count, programs.group, programs.devices)
    state = compiled_lib.begin(programs, slots, jax.random.key(0), None, 0)
    groups = slots.groups(np.ones(seeds_count, bool))
    split = seeds.sharding(spread_over)
    extra = [
        jax.jit(lambda n=n: jnp.zeros((programs.slots, n)), out_shardings=split)()
        for n in (EXTRA_FLOATS if processes > 1 else ())
    ]

    def chunk(state: Any, number: int) -> tuple[Any, dict[str, float]]:
        times: dict[str, float] = {}
        first = number * cell_lib.CHUNK
        steps = jnp.arange(first, first + cell_lib.CHUNK, dtype=jnp.int32)
        before = time.perf_counter()
        state, log = jax.block_until_ready(programs.run(state, groups, None, steps, None))
        times["chunk_s"] = time.perf_counter() - before
        timed(cluster, times, "gather", log)
        times["gather_bytes"] = sum(leaf.nbytes for leaf in jax.tree.leaves(log))
        for array in extra:
            timed(cluster, times, f"gather_{array.nbytes}_bytes", array)
        before = time.perf_counter()
        cluster.any(False)
        times["flag_s"] = time.perf_counter() - before
        return state, times

    done, times = 0, {}
    for _ in sys.stdin:
        # The first turn compiles, and its first chunk learns nothing before step 200: the third
        # chunk is the first one that counts.
        for _ in range(1 if done else 3):
            state, times = chunk(state, done)
            done += 1
        print(json.dumps(times), flush=True)


def timed(cluster: Cluster, times: dict[str, float], name: str, tree: Any) -> None:
    """Gather a tree, and note the seconds as `times[name + "_s"]`."""
    before = time.perf_counter()
    cluster.gather(tree)
    times[f"{name}_s"] = time.perf_counter() - before


if __name__ == "__main__":
    sys.exit(main())
