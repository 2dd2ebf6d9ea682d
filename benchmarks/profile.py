"""`python -m benchmarks.profile`: where the time of DDPG's learning step goes, by operation.

One group of seeds runs a chunk under XLA's profiler. An operation counts with its own time, without
that of the operations inside it. The operations at a chunk's start count too.
"""

import collections
import dataclasses
import functools
import re
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro
from rich import box
from rich.table import Table

from benchmarks.workload import CAPACITY
from cmedirl_jax import envs, training
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.start import devices
from cmedirl_jax.training import seeds
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings

STEPS = 250
"""Environment steps of the chunk."""
_NUMBERS = np.arange(STEPS, 2 * STEPS, dtype=np.int32)


@dataclasses.dataclass(frozen=True)
class Options:
    """What to profile.

    Attributes:
        group: Seeds in the group.
        hidden: Units of each hidden layer.
        layer_norm: Layer normalisation in the critic.
    """

    group: int = 10
    hidden: tuple[int, ...] = (64, 64)
    layer_norm: bool = False


def kinds(program: str) -> dict[str, str]:
    """The kind of each operation in a compiled program's text, by the operation's name."""
    bodies = dict(re.findall(r"^%?([\w.\-]+) \([^\n]*\{\n(.*?)^\}", program, re.M | re.S))
    kind_of = {}
    for name, operation, rest in re.findall(
        r"%?([\w.\-]+) = (?:\([^=]*?\)|\S+) ([\w\-]+)\((.*)", program
    ):
        called = re.search(r"calls=%?([\w.\-]+)", rest)
        source = re.search(r'op_name="([^"]*)"', rest)
        kind_of[name] = _kind(
            operation,
            bodies.get(called.group(1), "") if called else "",
            source.group(1) if source else "",
        )
    return kind_of


def _kind(operation: str, body: str, source: str) -> str:
    if operation in ("while", "conditional", "call"):
        return "control"
    if operation == "dot" or " dot(" in body:
        return "matrix products"
    if operation == "copy":
        return "copies"
    if any(f"{slicing}(" in body for slicing in ("gather", "dynamic-update-slice")):
        return "replay and log"
    if "xor(" in body or "shift-right-logical(" in body:
        return "random numbers"
    return "activations and losses" if "MLP" in source else "Adam, targets, environment"


def self_times(events: list[tuple[str, float, float]]) -> list[tuple[str, float]]:
    """Each event of one thread, `(name, start, duration)`, with its time outside inner events."""
    result: list[tuple[str, float]] = []
    open_events: list[tuple[str, float, float]] = []  # name, end, own time so far

    def close() -> None:
        name, _, own = open_events.pop()
        result.append((name, own))

    for name, start, duration in sorted(events, key=lambda event: (event[1], -event[2])):
        while open_events and start >= open_events[-1][1]:
            close()
        if open_events:
            outer, end, own = open_events[-1]
            open_events[-1] = outer, end, own - duration
        open_events.append((name, start + duration, duration))
    while open_events:
        close()
    return result


@ending.in_a_line("profile")
def main(options: Options) -> int:
    """Run a chunk under the profiler and print its table; returns the exit code."""
    devices()
    program, state = compiled_chunk(options)
    run = functools.partial(_run, program, state)
    run()
    began = time.perf_counter()
    run()
    seconds = time.perf_counter() - began

    # Own time and number of events of each kind, over all threads.
    kind_of = kinds(program.as_text() or "")
    spent: dict[str, float] = collections.defaultdict(float)
    operations: dict[str, int] = collections.defaultdict(int)
    for events in profiled(run):
        for name, duration in self_times(events):
            kind = kind_of.get(name, "control")
            spent[kind] += duration
            operations[kind] += 1

    screen.show(screen.console(), table(options, seconds, spent, operations))
    return 0


def compiled_chunk(options: Options) -> tuple[jax.stages.Compiled, Any]:
    """The compiled program of a group's chunk, and the state it starts from."""
    env = envs.make("MountainCarContinuous-v0")
    normalisation = "layer" if options.layer_norm else "none"
    architecture = Architecture(hidden=options.hidden, critic_normalisation=normalisation)
    settings = Settings(architecture=architecture)
    trainer = training.make(env, METHODS["ddpg"], settings, capacity=CAPACITY)
    keys = seeds.keys(jax.random.key(0), options.group)
    state = jax.jit(jax.vmap(lambda key: trainer.init(key, None, 0)))(keys)
    step_groups = jax.jit(seeds.step_groups(trainer.run, options.group))
    return step_groups.lower(state, 1, None, _NUMBERS).compile(), state


def _run(program: jax.stages.Compiled, state: Any) -> None:
    jax.block_until_ready(program(state, 1, None, _NUMBERS))


def profiled(run: Callable[[], None]) -> list[list[tuple[str, float, float]]]:
    """The operations of `run`, `(name, start, duration)` in nanoseconds, of each thread."""
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            run()
        (trace,) = Path(folder).rglob("*.xplane.pb")
        planes = jax.profiler.ProfileData.from_file(str(trace)).planes
        return [
            [
                (event.name, event.start_ns, event.duration_ns)
                for event in line.events
                if any(key == "hlo_op" for key, _ in event.stats)
            ]
            for plane in planes
            for line in plane.lines
        ]


def table(
    options: Options, seconds: float, spent: dict[str, float], operations: dict[str, int]
) -> Table:
    """Shares of the time by kind of operation, and microseconds of the unprofiled run."""
    shown = Table(box=box.SIMPLE, title=f"{options.group} seeds, width {options.hidden}")
    shown.add_column("operations")
    for name in ("share", "us per learning step", "operations per step of the group"):
        shown.add_column(name, justify="right")
    per_step = seconds / (STEPS * options.group) * 1e6
    whole = sum(spent.values())
    for kind, duration in sorted(spent.items(), key=lambda item: -item[1]):
        share = duration / whole
        shown.add_row(
            kind, f"{share:.0%}", f"{share * per_step:.1f}", f"{operations[kind] / STEPS:.0f}"
        )
    shown.add_row("all, without the profiler", "", f"{per_step:.1f}", "")
    return shown


if __name__ == "__main__":
    options = tyro.cli(Options, prog="python -m benchmarks.profile", description=__doc__)
    sys.exit(main(options))
