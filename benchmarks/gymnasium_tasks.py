"""`python -m benchmarks.gymnasium_tasks`: what Gymnasium costs, and what JAX saves its users.

Vectors: environment steps a second of Gymnasium's `SyncVectorEnv` and of `to_gymnasium_vector`,
with autoreset, driven by the same random actions. Training: learning steps a second of DDPG on a
task in JAX, on the same task through the host, and on tasks of MuJoCo, where it is installed; all
of them on one device. Each round measures all in turn.
"""

import dataclasses
import importlib.util
import statistics
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import gymnasium
import jax
import numpy as np
from gymnasium.vector import SyncVectorEnv, VectorEnv
from rich import box
from rich.table import Table

from benchmarks import measuring
from cmedirl_jax import envs, training
from cmedirl_jax.envs import HostEnv
from cmedirl_jax.ranges import Size
from cmedirl_jax.runs import start
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.training import host_loop, seeds
from cmedirl_jax.training.methods import METHODS

VECTORS = ("MountainCarContinuous-v0", "Pendulum-v1")
TASKS = ("Pendulum-v1", "gymnasium:Pendulum-v1", "InvertedPendulum-v5", "Reacher-v5")
CHUNK = 250
"""Steps of a call of the training loop."""


@dataclasses.dataclass(frozen=True)
class Options:
    """How much to measure, and where to write it.

    Attributes:
        count: Sub-environments of a vector.
        steps: Of each vector in a round.
        seeds: Learners that train side by side.
        rounds: Of all measurements in turn; medians are reported.
        out: A JSON file.
    """

    count: Size = 1_000
    steps: Size = 100
    seeds: Size = 16
    rounds: Size = 5
    out: Path | None = None


@ending.in_a_line("gymnasium_tasks")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "benchmarks.gymnasium_tasks", __doc__, arguments)
    if options.out is not None:
        measuring.outputs.check("out", options.out)
    start.devices()
    timed = {
        **{f"SyncVectorEnv {name}": _gymnasiums(name, options) for name in VECTORS},
        **{f"to_gymnasium_vector {name}": _ours(name, options) for name in VECTORS},
        **{f"DDPG on {name}": _learners(name, options) for name in _installed()},
    }
    rates = measure(timed, options.rounds)
    rows = [
        {"what": name, "steps_per_second": statistics.median(each), "rounds": each}
        for name, each in rates.items()
    ]
    gains = {name: _gain(rates, name) for name in VECTORS}
    table = Table(
        title=f"{options.count} sub-environments; {options.seeds} learners", box=box.SIMPLE
    )
    table.add_column("what")
    table.add_column("steps/s", justify="right")
    for row in rows:
        table.add_row(row["what"], f"{row['steps_per_second']:,.0f}")
    console = screen.console()
    screen.show(console, table)
    for name, gain in gains.items():
        screen.say(console, f"{name}: the vector in JAX steps {gain:.1f} times as fast")
    if options.out is not None:
        given = {"count": options.count, "seeds": options.seeds}
        content = {**measuring.heading("gymnasium_tasks"), **given, "rows": rows, "gains": gains}
        measuring.write(content, options.out)
    return 0


def measure(timed: dict[str, Callable[[], int]], rounds: int) -> dict[str, list[float]]:
    """Steps a second of each, whose calls give the steps they took; the first calls compile."""
    for call in timed.values():
        call()
    rates: dict[str, list[float]] = {name: [] for name in timed}
    for _ in range(rounds):
        for name, call in timed.items():
            began = time.perf_counter()
            taken = call()
            rates[name].append(taken / (time.perf_counter() - began))
    return rates


def _gain(rates: dict[str, list[float]], name: str) -> float:
    """The median over the rounds of our rate over Gymnasium's."""
    ours, theirs = rates[f"to_gymnasium_vector {name}"], rates[f"SyncVectorEnv {name}"]
    return statistics.median(x / y for x, y in zip(ours, theirs, strict=True))


def _installed() -> Iterator[str]:
    for name in TASKS:
        if not name.endswith("-v5") or importlib.util.find_spec("mujoco"):
            yield name


def _gymnasiums(name: str, options: Options) -> Callable[[], int]:
    makers = [lambda: gymnasium.make(name)] * options.count
    return _steps_of(SyncVectorEnv(makers), options)


def _ours(name: str, options: Options) -> Callable[[], int]:
    ours = f"{envs.GYMNASIUM_NAMESPACE}/{name}"
    return _steps_of(gymnasium.make_vec(ours, num_envs=options.count), options)


def _steps_of(vector: VectorEnv, options: Options) -> Callable[[], int]:
    vector.reset(seed=0)
    space: Any = vector.single_action_space
    shape = (options.steps, options.count, *space.shape)
    actions = np.random.default_rng(0).uniform(space.low, space.high, shape).astype(np.float32)

    def call() -> int:
        for each in actions:
            vector.step(each)
        return options.steps * options.count

    return call


def _learners(name: str, options: Options) -> Callable[[], int]:
    """DDPG's training loop in calls of `CHUNK` steps; learners learn at every step of them."""
    env, keys = envs.find(name), seeds.keys(jax.random.key(0), options.seeds)
    trainer = training.make(env, METHODS["ddpg"], capacity=10_000)
    begun: dict[str, Any] = {"step": CHUNK}
    if isinstance(env, HostEnv):
        halves = host_loop.compile_halves(trainer, env.spec.max_episode_steps)
        vector = env.vector(options.seeds)
        begun["states"] = host_loop.begin(halves, trainer, vector, keys)

        def run(states: Any, steps: np.ndarray) -> Any:
            return host_loop.run(halves, vector, states, None, steps)
    else:
        begun["states"] = jax.jit(jax.vmap(lambda key: trainer.init(key, None, 0)))(keys)
        grouped = seeds.map_groups(
            lambda state, steps: trainer.run(state, None, steps), seeds.group_size(options.seeds)
        )
        mapped = jax.jit(grouped)

        def run(states: Any, steps: np.ndarray) -> Any:
            return jax.block_until_ready(mapped(states, steps))

    def call() -> int:
        steps = np.arange(begun["step"], begun["step"] + CHUNK, dtype=np.int32)
        begun["states"], _ = run(begun["states"], steps)
        begun["step"] += CHUNK
        return CHUNK * options.seeds

    return call


if __name__ == "__main__":
    sys.exit(main())
