"""Time workloads in turn, each in a process of its own, and write what was measured."""

import dataclasses
import datetime
import importlib.metadata
import itertools
import json
import os
import platform
import re
import shlex
import statistics
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from benchmarks.serving import Worker
from benchmarks.workload import CAPACITY, Workload
from cmedirl_jax.runs.start import cores
from cmedirl_jax.runs.storage import outputs

PACKAGES = ("jax", "jaxlib", "flax", "optax", "numpy")


@dataclasses.dataclass(frozen=True)
class Record:
    """What was measured of one workload.

    Attributes:
        workload: what ran.
        rates: learning steps per second of each round, all seeds together.
        compile_seconds: spent on tracing and compiling until the end of the first call.
        peak_memory_bytes: of the process; None where the system does not account for it.
        platform: "cpu" or "gpu".
    """

    workload: Workload
    rates: list[float]
    compile_seconds: float
    peak_memory_bytes: int | None
    platform: str

    def fields(self) -> dict[str, Any]:
        """The fields of the JSON; seeds per second are of `CAPACITY` steps, as in the main job."""
        median = statistics.median(self.rates)
        workload = dataclasses.asdict(self.workload)
        width = workload.pop("hidden")
        return {
            **workload,
            "width": width,
            "learning_steps_per_second": median,
            "learning_steps_per_second_best": max(self.rates),
            "learning_steps_per_second_worst": min(self.rates),
            "seeds_per_second": median / CAPACITY,
            "compile_seconds": self.compile_seconds,
            "peak_memory_bytes": self.peak_memory_bytes,
            "platform": self.platform,
            "rounds": len(self.rates),
        }


@dataclasses.dataclass(frozen=True)
class Comparison:
    """The ratio of two workloads' rates, taken round by round, as a noisy machine requires."""

    suite: str
    name: str
    median: float
    low: float
    high: float


def compare(suite: str, name: str, above: Sequence[float], below: Sequence[float]) -> Comparison:
    """The ratios of two workloads' rates that were measured in turn, `above` over `below`."""
    ratios = [x / y for x, y in zip(above, below, strict=True)]
    return Comparison(suite, name, statistics.median(ratios), min(ratios), max(ratios))


def in_turn(workers: Sequence[tuple[Worker, int, float]], rounds: int) -> list[list[float]]:
    """Rates of each worker, `rounds` of them, measured A B C A B C ...

    Args:
        workers: each with the steps of a call, and how many learning steps these are for all seeds.
        rounds: how often each is asked.
    """
    rates: list[list[float]] = [[] for _ in workers]
    for _ in range(rounds):
        for (worker, steps, learning_steps), measured in zip(workers, rates, strict=True):
            measured.append(learning_steps / worker.seconds(steps))
    return rates


def measure(
    workloads: Sequence[Workload], rounds: int, *, compile_together: bool = False
) -> list[Record]:
    """Time workloads in turn; those of one device run on one core.

    Args:
        workloads: what to time.
        rounds: how often.
        compile_together: let them all compile at once. That is faster, but then
            `compile_seconds` is not what one of them takes.
    """
    workers: list[Worker] = []
    try:
        for workload in workloads:
            workers += [start(workload, steps_per_call(workload))]
            if not compile_together:
                workers[-1].wait()
        asked = []
        for worker, workload in zip(workers, workloads, strict=True):
            # Nothing is timed while another still compiles.
            worker.wait()
            steps = steps_per_call(workload)
            asked.append((worker, steps, workload.seeds * workload.running * steps))
        rates = in_turn(asked, rounds)
        return [
            Record(
                workload,
                measured,
                worker.facts["compile_seconds"],
                worker.peak_memory_bytes,
                worker.facts["platform"],
            )
            for workload, worker, measured in zip(workloads, workers, rates, strict=True)
        ]
    finally:
        for worker in workers:
            worker.stop()


def start(workload: Workload, steps: int, **environment: str) -> Worker:
    """Start the process of a workload, whose first call takes `steps` steps."""
    options = json.dumps({**dataclasses.asdict(workload), "steps": steps})
    command = [sys.executable, "-m", "benchmarks.worker", options]
    return Worker(command, one_core() if workload.devices == 1 else None, **environment)


def steps_per_call(workload: Workload) -> int:
    """Steps of a call of some seconds: more for few learners, fewer for large ones."""
    more = min(4, max(1, round(10_000 / (250 * workload.seeds))))
    less = max(1, (workload.hidden[0] // 64) * workload.batch // 32, workload.seeds // 400)
    return max(50, 250 * more // less)


def one_core() -> list[int] | None:
    """The last core that this process may use; None where the system does not tell."""
    return sorted(os.sched_getaffinity(0))[-1:] if hasattr(os, "sched_getaffinity") else None


def heading(program: str) -> dict[str, Any]:
    """The first fields of every file of measurements."""
    # Paths of this machine by their names alone.
    arguments = [re.sub(r"^(--?[\w-]+=)?/.*/", r"\1", argument) for argument in sys.argv[1:]]
    return {
        "command": f"python -m benchmarks.{program} " + shlex.join(arguments),
        "date": datetime.date.today().isoformat(),
        "machine": machine(),
        "versions": versions(),
    }


def write(result: dict[str, Any], path: Path) -> None:
    """Write a file of measurements; makes its folder."""
    outputs.write(path, (json.dumps(result, indent=1) + "\n").encode())


def machine() -> dict[str, Any]:
    """The machine that the numbers were measured on."""
    model = platform.processor()
    information = Path("/proc/cpuinfo")
    if information.exists():
        lines = information.read_text().splitlines()
        names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
        model = next(itertools.chain(names, [model]))
    return {
        "processor": model,
        "cores": cores(),
        "system": platform.system(),
        "python": platform.python_version(),
    }


def versions() -> dict[str, str]:
    """Versions of the packages that the numbers depend on."""
    return {name: importlib.metadata.version(name) for name in PACKAGES}
