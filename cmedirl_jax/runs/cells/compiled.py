"""The compiled functions of a method, and the lanes of seeds that they step."""

import functools
from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import numpy as np

from cmedirl_jax import training
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.envs import Env
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cells import evaluator as evaluator_lib
from cmedirl_jax.runs.cells.evaluator import Judge
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.cells.slots import Lanes
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.training import Log, TrainingState, seeds
from cmedirl_jax.training.methods import METHODS, Method, Settings


class Programs(NamedTuple):
    """The compiled functions of a method. Every cell of the method uses the same ones.

    Attributes:
        init: `(keys [lanes], groups, data, n_demonstrations) -> TrainingState` `[lanes, ...]`.
        run: `(state, groups, data, steps, max_episodes) -> (TrainingState, Log)`; the state is
            donated. Only the first `groups` groups of lanes on each device move.
        permute: `(state, move [lanes]) -> TrainingState`; lane i takes lane move[i]'s. Donated too.
        judge: noise-free rollouts.
        lanes: how many seeds fit in.
        group: lanes that are stepped together on a device.
        devices: devices that share the lanes.
        sharding: how the lanes lie on them.
    """

    init: Callable[..., TrainingState]
    run: Callable[..., tuple[TrainingState, Log]]
    permute: Callable[[TrainingState, np.ndarray], TrainingState]
    judge: Judge
    lanes: int
    group: int
    devices: int
    sharding: jax.sharding.Sharding


def compile_networks(
    env: Env, architecture: Architecture, group: int, devices: list[jax.Device]
) -> Callable[[jax.Array, int], Any]:
    """Jit the drawing of the networks that every method starts from: `(keys, groups) -> networks`.

    Apart from `compile_method`, because the random numbers are most of what an `init` compiles.
    """
    trainer = training.make(env, METHODS["ddpg"], Settings(architecture), capacity=1)
    drawn = seeds.step_groups(lambda key: (key, trainer.draw_networks(key)), group)

    def draw(keys: jax.Array, groups: int) -> Any:
        return seeds.map_devices(drawn, devices)(keys, groups)[1]

    return jax.jit(draw, out_shardings=seeds.sharding(devices))


def compile_method(
    env: Env,
    method: Method,
    settings: Settings,
    judge: Judge,
    draw_networks: Callable[[jax.Array, int], Any],
    *,
    group: int,
    seeds_count: int,
    devices: list[jax.Device],
    capacity: int,
    subset_size: int | None,
) -> Programs:
    """Jit a method's training, over seeds in groups and over devices. Compiles at first use."""
    trainer = training.make(env, method, settings, capacity=capacity, subset_size=subset_size)

    def spread(function: Callable) -> Callable:
        return seeds.map_devices(seeds.step_groups(function, group), devices)

    def start(
        keys: jax.Array, networks: Any, groups: int, data: HotStartData | None, n_demos: int
    ) -> TrainingState:
        def of_seed(drawn: tuple[jax.Array, Any], *shared: Any):
            key, networks = drawn
            return drawn, trainer.init(key, *shared, networks)

        return spread(of_seed)((keys, networks), groups, data, n_demos)[1]

    def permute(state: TrainingState, move: np.ndarray) -> TrainingState:
        return jax.tree.map(lambda leaf: leaf[move], state)

    # One sharding everywhere: another one, even if equivalent, would compile again.
    split = seeds.sharding(devices)
    start = jax.jit(start, out_shardings=split)

    def init(
        keys: jax.Array, groups: int, data: HotStartData | None, n_demonstrations: int
    ) -> TrainingState:
        return start(keys, draw_networks(keys, groups), groups, data, n_demonstrations)

    return Programs(
        init=init,
        run=jax.jit(spread(trainer.run), donate_argnums=0, out_shardings=split),
        permute=jax.jit(permute, donate_argnums=0, out_shardings=split),
        judge=judge,
        lanes=seeds.padded(seeds_count, group, len(devices)),
        group=group,
        devices=len(devices),
        sharding=split,
    )


def begin(
    programs: Programs, lanes: Lanes, key: jax.Array, data: HotStartData | None, n_demos: int
) -> TrainingState:
    """Initialise the seeds in `lanes`; the idle lanes behind them hold others."""
    groups = lanes.groups(np.ones(lanes.seeds, bool))
    keys = seeds.keys(key, programs.lanes)[lanes.seed]
    return programs.init(keys, groups, data, n_demos)


def pack(
    programs: Programs, lanes: Lanes, state: TrainingState, active: np.ndarray
) -> tuple[TrainingState, int]:
    """Bring the seeds `active` `[seeds]` to the front; how many groups hold them now."""
    move = lanes.pack(active)
    if move is not None:
        state = programs.permute(state, move)
    return state, lanes.groups(active)


def compiler(
    grid: StudyConfig, env: Env, budget: Budget, devices: list[jax.Device]
) -> Callable[[Method, Settings], Programs]:
    """A function that makes each method's programs once: for all cells, and for the experts too."""
    seeds_count, capacity = grid.seeds, budget.max_steps
    if grid.demos is None:
        seeds_count = max(seeds_count, grid.experts.seeds)
        capacity = max(capacity, grid.experts.steps)

    def group(architecture: Architecture) -> int:
        return grid.group or seeds.group_size(grid.seeds, len(devices), architecture.hidden)

    @functools.cache
    def judge(architecture: Architecture) -> Judge:
        return evaluator_lib.of_networks(env, architecture, group(architecture), devices)

    @functools.cache
    def draw_networks(architecture: Architecture) -> Callable:
        return compile_networks(env, architecture, group(architecture), devices)

    @functools.cache
    def compile_once(method: Method, settings: Settings) -> Programs:
        return compile_method(
            env,
            method,
            settings,
            judge(settings.architecture),
            draw_networks(settings.architecture),
            group=group(settings.architecture),
            seeds_count=seeds_count,
            devices=devices,
            capacity=capacity,
            subset_size=max(grid.n_demos),
        )

    return compile_once
