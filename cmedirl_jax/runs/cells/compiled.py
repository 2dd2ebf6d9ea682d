"""The compiled functions of a method, and the slots of seeds that they step."""

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
from cmedirl_jax.runs.cells.evaluator import Evaluator
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.cells.slots import Slots
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.training import Log, TrainingState, seeds
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings


class CompiledMethod(NamedTuple):
    """The compiled functions of a method. Every cell of the method uses the same ones.

    Attributes:
        init: `(keys [slots], groups, data, n_demonstrations) -> TrainingState` `[slots, ...]`.
        run: `(state, groups, data, steps, max_episodes) -> (TrainingState, Log)`; the state is
            donated. Only the first `groups` groups of slots on each device move.
        permute: `(state, move [slots]) -> TrainingState`; slot i takes slot move[i]'s. Donated too.
        evaluator: noise-free rollouts.
        slots: how many seeds fit in.
        group: slots that are stepped together on a device.
        devices: devices that share the slots.
        sharding: how the slots lie on them.
    """

    init: Callable[..., TrainingState]
    run: Callable[..., tuple[TrainingState, Log]]
    permute: Callable[[TrainingState, np.ndarray], TrainingState]
    evaluator: Evaluator
    slots: int
    group: int
    devices: int
    sharding: jax.sharding.Sharding


def compile_networks(
    env: Env, architecture: Architecture, group: int, devices: list[jax.Device]
) -> Callable[[jax.Array, int], Any]:
    """Jit the drawing of the networks that every method starts from: `(keys, groups) -> networks`.

    Apart from `compile_method`, because the random numbers are most of what an `init` compiles.
    """
    trainer = training.make(env, METHODS["ddpg"], Settings(architecture=architecture), capacity=1)
    drawn = seeds.step_groups(lambda key: (key, trainer.draw_networks(key)), group)

    def draw(keys: jax.Array, groups: int) -> Any:
        return seeds.map_devices(drawn, devices)(keys, groups)[1]

    return jax.jit(draw, out_shardings=seeds.sharding(devices))


def compile_method(
    env: Env,
    method: Method,
    settings: Settings,
    evaluator: Evaluator,
    draw_networks: Callable[[jax.Array, int], Any],
    *,
    group: int,
    seeds_count: int,
    devices: list[jax.Device],
    capacity: int,
    subset_size: int | None,
) -> CompiledMethod:
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

    return CompiledMethod(
        init=init,
        run=jax.jit(spread(trainer.run), donate_argnums=0, out_shardings=split),
        permute=jax.jit(permute, donate_argnums=0, out_shardings=split),
        evaluator=evaluator,
        slots=seeds.padded(seeds_count, group, len(devices)),
        group=group,
        devices=len(devices),
        sharding=split,
    )


def begin(
    programs: CompiledMethod, slots: Slots, key: jax.Array, data: HotStartData | None, n_demos: int
) -> TrainingState:
    """Initialise the seeds in `slots`; the idle slots behind them hold others."""
    groups = slots.groups(np.ones(slots.seeds, bool))
    keys = seeds.keys(key, programs.slots)[slots.seed]
    return programs.init(keys, groups, data, n_demos)


def pack(
    programs: CompiledMethod, slots: Slots, state: TrainingState, active: np.ndarray
) -> tuple[TrainingState, int]:
    """Bring the seeds `active` `[seeds]` to the front; how many groups hold them now."""
    move = slots.pack(active)
    if move is not None:
        state = programs.permute(state, move)
    return state, slots.groups(active)


def compiler(
    config: StudyConfig, env: Env, budget: Budget, devices: list[jax.Device]
) -> Callable[[Method, Settings], CompiledMethod]:
    """A function that makes each method's programs once: for all cells, and for the experts too."""
    seeds_count, capacity = config.seeds, budget.max_steps
    if config.demos is None:
        seeds_count = max(seeds_count, config.experts.seeds)
        capacity = max(capacity, config.experts.steps)

    def group(architecture: Architecture) -> int:
        return config.group or seeds.group_size(config.seeds, len(devices), architecture.hidden)

    @functools.cache
    def evaluator(architecture: Architecture) -> Evaluator:
        return evaluator_lib.of_networks(env, architecture, group(architecture), devices)

    @functools.cache
    def draw_networks(architecture: Architecture) -> Callable:
        return compile_networks(env, architecture, group(architecture), devices)

    @functools.cache
    def compile_once(method: Method, settings: Settings) -> CompiledMethod:
        return compile_method(
            env,
            method,
            settings,
            evaluator(settings.architecture),
            draw_networks(settings.architecture),
            group=group(settings.architecture),
            seeds_count=seeds_count,
            devices=devices,
            capacity=capacity,
            subset_size=max(config.n_demos),
        )

    return compile_once
