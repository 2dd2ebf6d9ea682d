"""`python -m benchmarks.host_tasks`: where a step of a task on the host goes, and what helps.

Phases: microseconds of one environment step of all learners, on one device: the simulator, its
resets, the compiled call that takes the updates and chooses the next actions, and the same call
before learning starts, which is all that several updates a call could spare. Rates: learning steps
a second of DDPG, all learners together, as `run_grid` trains them, in turn: on one device, on every
device with a thread each, and there with a process for each sub-environment.
"""

import dataclasses
import functools
import itertools
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import numpy as np
from rich import box
from rich.table import Table

from benchmarks import measuring, ours
from cmedirl_jax import envs, training
from cmedirl_jax.envs import HostEnv
from cmedirl_jax.ranges import Size
from cmedirl_jax.runs import start
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cluster.base import ClusterOptions
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.training import host_loop, seeds
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings

CAPACITY = 10_000
PHASES = ("simulator", "resets", "updates", "without updates")


@dataclasses.dataclass(frozen=True)
class Options:
    """How much to measure, and where to write it.

    Attributes:
        tasks: Tasks of Gymnasium.
        seeds: Learners that train side by side.
        steps: Environment steps of each in a round.
        rounds: Of all measurements in turn; medians are reported.
        out: A JSON file.
    """

    tasks: tuple[str, ...] = ("gymnasium:Pendulum-v1", "InvertedPendulum-v5", "Reacher-v5")
    seeds: Size = 16
    steps: Size = 250
    rounds: Size = 5
    out: Path | None = None


@ending.in_a_line("host_tasks")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "benchmarks.host_tasks", __doc__, arguments)
    if options.out is not None:
        measuring.outputs.check("out", options.out)
    _, devices = start.start(ClusterOptions(), None, options.seeds, {})
    entries: list[dict[str, Any]] = []
    for name in options.tasks:
        variants = {
            "one device": trainer(name, options, devices[:1], asynchronous=False),
            "a thread for each device": trainer(name, options, devices, asynchronous=False),
            "and a process for each task": trainer(name, options, devices, asynchronous=True),
        }
        rates = {variant: [] for variant in variants}
        for _, (variant, call) in itertools.product(range(options.rounds), variants.items()):
            began = time.perf_counter()
            call()
            taken = options.seeds * options.steps
            rates[variant].append(taken / (time.perf_counter() - began))
        entries.append({"task": name, "microseconds": phases(name, options), "rates": rates})
    console = screen.console()
    screen.show(console, table(entries, options))
    if options.out is not None:
        given = {"seeds": options.seeds, "devices": len(devices), "tasks": entries}
        measuring.write({**measuring.heading("host_tasks"), **given}, options.out)
    return 0


def _found(name: str, *, asynchronous: bool = False) -> HostEnv:
    env = envs.find(name, asynchronous=asynchronous)
    assert isinstance(env, HostEnv)
    return env


def trainer(
    name: str, options: Options, devices: Sequence[Any], *, asynchronous: bool
) -> Callable[[], None]:
    """A function that trains all learners for a round, compiled."""
    env = _found(name, asynchronous=asynchronous)
    compile_once = compiled_lib.compiler(env, devices, capacity=CAPACITY, subset_size=None)
    programs = compile_once(METHODS["ddpg"], Settings(), options.seeds)
    # Past the first steps, which do not learn.
    first = Settings().schedule.learning_starts
    advance = ours.stepping(programs, np.ones(options.seeds, bool), first=first)
    # Every episode has ended once, so that what begins the next one is compiled too.
    for _ in range(1 + env.spec.max_episode_steps // options.steps):
        advance(options.steps)
    return functools.partial(advance, options.steps)


def phases(name: str, options: Options) -> dict[str, float]:
    """Microseconds of each phase of a step, on one device; the compiled call is waited for."""
    env = _found(name)
    keys = seeds.keys(jax.random.key(0), options.seeds)
    made = training.make(env, METHODS["ddpg"], capacity=CAPACITY)
    halves = host_loop.compile_halves(made, env.spec.max_episode_steps)
    vector = env.vector(options.seeds)
    states = host_loop.begin(halves, made, vector, keys)
    spent: dict[str, float] = dict.fromkeys(map(str, PHASES), 0.0)

    def timed(phase: str, function: Callable[..., Any], steps: int) -> Callable[..., Any]:
        def call(*args: Any, **kwargs: Any) -> Any:
            began = time.perf_counter()
            found = jax.block_until_ready(function(*args, **kwargs))
            spent[phase] += 1e6 * (time.perf_counter() - began) / steps
            return found

        return call

    # The first episodes compile, and end.
    begin = Settings().schedule.learning_starts
    end = begin + env.spec.max_episode_steps
    states, _ = host_loop.run(halves, vector, states, None, np.arange(begin, end, dtype=np.int32))
    learn, steps = halves.learn, np.arange(min(options.steps, begin), dtype=np.int32)
    halves = halves._replace(learn=timed("without updates", learn, len(steps)))
    states, _ = host_loop.run(halves, vector, states, None, steps)
    vector.step = timed("simulator", vector.step, options.steps)
    vector.reset = timed("resets", vector.reset, options.steps)
    halves = halves._replace(learn=timed("updates", learn, options.steps))
    numbers = np.arange(end, end + options.steps, dtype=np.int32)
    host_loop.run(halves, vector, states, None, numbers)
    return spent


def table(entries: list[dict[str, Any]], options: Options) -> Table:
    """A row for each task."""
    shown = Table(title=f"{options.seeds} learners: microseconds; steps a second", box=box.SIMPLE)
    shown.add_column("task")
    for name in (*PHASES, *entries[0]["rates"]):
        shown.add_column(name, justify="right")
    for entry in entries:
        rates = [statistics.median(each) for each in entry["rates"].values()]
        numbers = [*entry["microseconds"].values(), *rates]
        shown.add_row(entry["task"], *(f"{number:,.0f}" for number in numbers))
    return shown


if __name__ == "__main__":
    sys.exit(main())
