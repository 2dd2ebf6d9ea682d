"""`python -m benchmarks.profile`: where the time of DDPG's learning step goes, by operation.

One group of seeds runs a chunk under XLA's own profiler. An operation counts with the time that
passes within it and not within another one; operations of a chunk's start count as well.
"""

import collections
import dataclasses
import re
import sys
import tempfile
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import tyro
from rich import box
from rich.console import Console
from rich.table import Table

from benchmarks.workload import CAPACITY
from cmedirl_jax import envs, training
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training import seeds
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings

STEPS = 250


@dataclasses.dataclass(frozen=True)
class Options:
    """What to profile.

    Attributes:
        group: Seeds of the group.
        hidden: Units of each hidden layer.
        layer_norm: Layer normalisation in the critic.
    """

    group: int = 10
    hidden: tuple[int, ...] = (64, 64)
    layer_norm: bool = False


def kinds(program: str) -> dict[str, str]:
    """The kind of each operation in a compiled program's text, by the operation's name."""
    bodies = dict(re.findall(r"^%?([\w.\-]+) \([^\n]*\{\n(.*?)^\}", program, re.M | re.S))
    found = {}
    for name, operation, rest in re.findall(
        r"%?([\w.\-]+) = (?:\([^=]*?\)|\S+) ([\w\-]+)\((.*)", program
    ):
        called = re.search(r"calls=%?([\w.\-]+)", rest)
        source = re.search(r'op_name="([^"]*)"', rest)
        found[name] = _kind(
            operation,
            bodies.get(called.group(1), "") if called else "",
            source.group(1) if source else "",
        )
    return found


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
    """Each `(name, start, duration)` of one thread with its duration less that of those within."""
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


def main(options: Options) -> int:
    """Run a chunk under the profiler and print its table."""
    env = envs.make("MountainCarContinuous-v0")
    normalisation = "layer" if options.layer_norm else "none"
    architecture = Architecture(hidden=options.hidden, critic_normalisation=normalisation)
    settings = Settings(architecture=architecture)
    trainer = training.make(env, METHODS["ddpg"], settings, capacity=CAPACITY)
    keys = seeds.keys(jax.random.key(0), options.group)
    state = jax.jit(jax.vmap(lambda key: trainer.init(key, None, 0)))(keys)
    numbers = jnp.arange(STEPS, 2 * STEPS)
    program = (
        jax.jit(seeds.step_groups(trainer.run, options.group))
        .lower(state, 1, None, numbers)
        .compile()
    )
    run = lambda: jax.block_until_ready(program(state, 1, None, numbers))  # noqa: E731
    run()
    began = time.perf_counter()
    run()
    seconds = time.perf_counter() - began
    with tempfile.TemporaryDirectory() as folder:
        with jax.profiler.trace(folder):
            run()
        (trace,) = Path(folder).rglob("*.xplane.pb")
        planes = jax.profiler.ProfileData.from_file(str(trace)).planes
        threads = [
            [
                (event.name, event.start_ns, event.duration_ns)
                for event in line.events
                if any(key == "hlo_op" for key, _ in event.stats)
            ]
            for plane in planes
            for line in plane.lines
        ]
    kind_of = kinds(program.as_text() or "")
    spent: dict[str, float] = collections.defaultdict(float)
    operations: dict[str, int] = collections.defaultdict(int)
    for thread in threads:
        for name, duration in self_times(thread):
            kind = kind_of.get(name, "control")
            spent[kind] += duration
            operations[kind] += 1
    whole = sum(spent.values())
    table = Table(box=box.SIMPLE, title=f"{options.group} seeds, width {options.hidden}")
    table.add_column("operations")
    for name in ("share", "us per learning step", "operations per step of the group"):
        table.add_column(name, justify="right")
    per_step = seconds / (STEPS * options.group) * 1e6
    for kind, duration in sorted(spent.items(), key=lambda item: -item[1]):
        share = duration / whole
        table.add_row(
            kind, f"{share:.0%}", f"{share * per_step:.1f}", f"{operations[kind] / STEPS:.0f}"
        )
    table.add_row("all, without the profiler", "", f"{per_step:.1f}", "")
    Console().print(table)
    return 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Options, prog="python -m benchmarks.profile")))
