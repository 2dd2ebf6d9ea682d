"""The library's training loop, as `experiments.run_grid` runs it."""

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.workload import CAPACITY, Workload
from cmedirl_jax import envs
from cmedirl_jax.agents.hot_start import HotStartData, HotStartHParams
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.irl.reward_batches import RewardBatchSettings
from cmedirl_jax.irl.rewards import RewardNetworkSettings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cells import compiled as compiled_lib
from cmedirl_jax.runs.cells import pools
from cmedirl_jax.runs.cells.compiled import CompiledMethod
from cmedirl_jax.runs.cells.slots import Slots
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.schedules import RewardSchedule, Schedule
from cmedirl_jax.training.settings import Settings


def start(workload: Workload, pool: Demonstrations) -> Callable[[int], None]:
    """A function that takes so many steps with every seed, compiled by its first call."""
    settings = Settings(
        architecture=Architecture(
            hidden=workload.hidden,
            critic_normalisation="layer" if workload.layer_norm else "none",
        ),
        reward_network=RewardNetworkSettings(hidden=workload.hidden),
        reward_batches=RewardBatchSettings(batch_size=workload.batch),
        # Never frozen, so that its cost is the same however long the benchmark runs.
        reward_schedule=RewardSchedule(stop=None),
        # The hot start is over before anything is timed, so a poor one will do.
        hot_start=HotStartHParams(steps=20),
        # Learning starts at step 0, because steps without updates would look fast. The cloning
        # never fades, so that its cost stays the same.
        schedule=Schedule(
            batch_size=workload.batch, learning_starts=0, behaviour_cloning_steps=10**9
        ),
    )
    programs = compile_programs(
        workload.method,
        settings,
        jax.devices()[: workload.devices],
        seeds_count=workload.seeds,
        group=workload.group,
        subset_size=workload.n_demos,
    )

    # Seeds that have ended are spread at random, then moved behind those that run.
    data = None
    if METHODS[workload.method].uses_demonstrations:
        data = pools.of_learners(pool, workload.seeds).data
    running = np.arange(workload.seeds) < round(workload.running * workload.seeds)
    active = np.random.default_rng(0).permutation(running)
    return stepping(programs, active, data, workload.n_demos)


def stepping(
    programs: CompiledMethod,
    active: np.ndarray,
    data: HotStartData | None = None,
    n_demos: int = 0,
    first: int = 0,
) -> Callable[[int], None]:
    """A function that takes so many steps with every seed that is `active` `[seeds]`.

    Args:
        programs: the method's.
        active: which seeds run.
        data: the demonstrations, for a method that uses them.
        n_demos: demonstrations of each seed.
        first: number of the first step.
    """
    slots = Slots(programs.slots, len(active), programs.group, programs.devices)
    state = compiled_lib.begin(programs, slots, jax.random.key(0), data, n_demos)
    state, groups = compiled_lib.pack(programs, slots, state, active)
    taken = first

    def advance(steps: int) -> None:
        nonlocal state, taken
        numbers = jnp.arange(taken, taken + steps, dtype=jnp.int32)
        state, log = programs.run(state, groups, data, numbers, None)
        jax.block_until_ready((state, log))
        taken += steps

    return advance


def compile_programs(
    method: str,
    settings: Settings,
    devices: Sequence[Any],
    *,
    seeds_count: int,
    group: int | None = None,
    subset_size: int | None = None,
) -> CompiledMethod:
    """One method's programs, with the main job's replay.

    Args:
        method: its name.
        settings: its settings.
        devices: that share the seeds.
        seeds_count: how many seeds.
        group: seeds that a device steps together; None: the library's choice.
        subset_size: demonstrations of each seed; None without any.
    """
    programs = compiled_lib.compiler(
        envs.make("MountainCarContinuous-v0"),
        devices,
        capacity=CAPACITY,
        subset_size=subset_size,
        group=group,
    )
    return programs(METHODS[method], settings, seeds_count)
