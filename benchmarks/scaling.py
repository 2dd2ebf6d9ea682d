"""`python -m benchmarks.scaling`: the same seeds on one process and on two, chunk by chunk.

Three groups of processes take turns: one process with two devices, two processes with one device
each over loopback, and one process with one device and half of the seeds, which is the share of one
device. What the processes tell each other after every chunk is timed apart.
"""

import argparse
import json
import socket
import statistics
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks import measuring
from cmedirl_jax import envs, seeds
from cmedirl_jax.methods import METHODS, Settings
from experiments import cells, distributed, judging

GROUPS = {"1 process x 2 devices": (1, 2), "2 processes x 1 device": (2, 1), "its share": (1, 1)}
"""Processes, and devices of each."""
EXTRA_FLOATS = (2**12, 2**14, 2**16)
"""Sizes of further arrays that are gathered, per seed, to tell latency from bandwidth."""


def main() -> None:
    """Measure, or be one of the processes that are measured."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--method", default="ddpg", help="a method without demonstrations")
    parser.add_argument("--seeds", type=int, default=100)
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--worker", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.worker is not None:
        work(**options.worker)
        return
    measured = measure(options.method, options.seeds, options.rounds)
    result = measuring.heading("scaling") | {"method": options.method, "groups": measured}
    print(json.dumps(result, indent=1))
    if options.json is not None:
        measuring.write(result, options.json)


def measure(method: str, seeds_count: int, rounds: int) -> dict[str, Any]:
    """Let the groups take turns; medians and extremes of each one's times."""
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
        # The first turn compiles.
        found = [{name: turn(workers) for name, workers in started.items()} for _ in range(rounds)]
    finally:
        for worker in (worker for workers in started.values() for worker in workers):
            worker.kill()
    return {name: spread([turns[name] for turns in found]) for name in started}


def start(job: dict[str, Any]) -> subprocess.Popen:
    """A process that is measured."""
    command = [sys.executable, "-m", "benchmarks.scaling", "--worker", json.dumps(job)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def turn(workers: list[subprocess.Popen]) -> dict[str, float]:
    """One chunk of a group; the times that its first process measured."""
    for worker in workers:
        worker.stdin.write("go\n")
        worker.stdin.flush()
    # The transport of the collectives prints too.
    lines = [next(line for line in worker.stdout if line.startswith("{")) for worker in workers]
    return json.loads(lines[0])


def spread(turns: list[dict[str, float]]) -> dict[str, list[float]]:
    """Median, least and largest of every quantity."""
    columns = {name: [found[name] for found in turns] for name in turns[0]}
    return {
        name: [statistics.median(column), min(column), max(column)]
        for name, column in columns.items()
    }


def work(
    method: str, seeds_count: int, devices: int, coordinator: str, processes: int, index: int
) -> None:
    """Train a chunk whenever a line comes, and print how long that took, as JSON."""
    jax.config.update("jax_num_cpu_devices", devices)
    if processes > 1:
        jax.distributed.initialize(coordinator, processes, index)
    spread_over = distributed.devices(devices, seeds_count)
    env, settings = envs.make("MountainCarContinuous-v0"), Settings()
    group = seeds.group_size(seeds_count, len(spread_over), settings.architecture.hidden)
    shape = (env, settings.architecture, group, spread_over)
    judge, draw = judging.of_networks(*shape), cells.compile_networks(*shape)
    sizes = {"group": group, "seeds_count": seeds_count, "capacity": 12_000, "subset_size": 1}
    programs = cells.compile_method(
        env, METHODS[method], settings, judge, draw, devices=spread_over, **sizes
    )
    _, state, groups = cells.begin(programs, jax.random.key(0), None, 0, seeds_count)
    split = seeds.sharding(spread_over)
    extra = [
        jax.jit(lambda n=n: jnp.zeros((programs.lanes, n)), out_shardings=split)()
        for n in EXTRA_FLOATS
    ]
    begun, warm = 0, False
    for _ in sys.stdin:
        for last in (True,) if warm else (False, False, True):
            times = {}
            steps = jnp.arange(begun, begun + cells.CHUNK, dtype=jnp.int32)
            before = time.perf_counter()
            state, log = jax.block_until_ready(programs.run(state, groups, None, steps, None))
            times["chunk_s"] = time.perf_counter() - before
            timed(times, "gather", log)
            for number, array in zip(EXTRA_FLOATS, extra, strict=True):
                timed(times, f"gather_{number}", array)
            before = time.perf_counter()
            distributed.any_process(False)
            times["flag_s"] = time.perf_counter() - before
            begun += cells.CHUNK
            warm = last
        print(json.dumps(times), flush=True)


def timed(times: dict[str, float], name: str, tree: Any) -> None:
    """Gather a tree; note the seconds and the bytes."""
    before = time.perf_counter()
    whole = distributed.gather(tree)
    times[f"{name}_s"] = time.perf_counter() - before
    times[f"{name}_bytes"] = sum(np.asarray(leaf).nbytes for leaf in jax.tree.leaves(whole))


if __name__ == "__main__":
    main()
