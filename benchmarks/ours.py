"""The library's training loop, as `experiments.run_grid` runs it."""

from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.workload import CAPACITY, Workload
from cmedirl_jax import envs, hot_start, seeds
from cmedirl_jax.demonstrations import Demonstrations
from cmedirl_jax.hot_start import HotStartHParams
from cmedirl_jax.methods import METHODS, RewardNetworkSettings, Settings
from cmedirl_jax.networks import Architecture
from cmedirl_jax.schedules import RewardSchedule, Schedule
from experiments import judging
from experiments import programs as programs_lib
from experiments.lanes import Lanes


def start(workload: Workload, pool: Demonstrations) -> Callable[[int], None]:
    """A function that takes so many steps with every seed, compiled by its first call."""
    env = envs.make("MountainCarContinuous-v0")
    settings = Settings(
        architecture=Architecture(
            hidden=workload.hidden,
            critic_normalisation="layer" if workload.layer_norm else "none",
        ),
        # Never frozen, so that its cost is the same however long the benchmark runs.
        reward_network=RewardNetworkSettings(hidden=workload.hidden),
        reward_schedule=RewardSchedule(stop=None, batch_size=workload.batch),
        # The hot start is over before anything is timed; it need not be a good one.
        hot_start=HotStartHParams(steps=20),
        # At once, for a call that only collected would look fast; the cloning never fades either.
        schedule=Schedule(
            batch_size=workload.batch, learning_starts=0, behaviour_cloning_steps=10**9
        ),
    )
    devices = jax.devices()[: workload.devices]
    group = workload.group or seeds.group_size(workload.seeds, len(devices), workload.hidden)
    programs = programs_lib.compile_method(
        env,
        METHODS[workload.method],
        settings,
        judging.of_networks(env, settings.architecture, group, devices),
        programs_lib.compile_networks(env, settings.architecture, group, devices),
        group=group,
        seeds_count=workload.seeds,
        devices=devices,
        capacity=CAPACITY,
        subset_size=workload.n_demos,
    )
    data = hot_start.data(pool) if METHODS[workload.method].uses_demonstrations else None
    lanes = Lanes(programs.lanes, workload.seeds, programs.group, programs.devices)
    state = programs_lib.begin(programs, lanes, jax.random.key(0), data, workload.n_demos)
    running = np.arange(workload.seeds) < round(workload.running * workload.seeds)
    active = np.random.default_rng(0).permutation(running)
    state, groups = programs_lib.pack(programs, lanes, state, active)
    taken = 0

    def advance(steps: int) -> None:
        nonlocal state, taken
        numbers = jnp.arange(taken, taken + steps, dtype=jnp.int32)
        state, log = programs.run(state, groups, data, numbers, None)
        jax.block_until_ready((state, log))
        taken += steps

    return advance
