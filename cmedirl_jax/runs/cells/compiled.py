"""The compiled functions of a method that trains networks."""

import functools
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np
from gymnasium.vector import VectorEnv

from cmedirl_jax import compilation, training
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cells import evaluator as evaluator_lib
from cmedirl_jax.runs.cells import host, pools
from cmedirl_jax.runs.cells.evaluator import Evaluator
from cmedirl_jax.runs.cells.slots import Slots
from cmedirl_jax.runs.cluster.base import ALONE
from cmedirl_jax.training import Log, Trainer, TrainingState, seeds
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import DemonstrationSubset


class CompiledMethod(NamedTuple):
    """The compiled functions of a method. Every cell of the method uses the same ones.

    Attributes:
        draw_networks: `(keys [slots], groups) -> networks` `[slots, ...]`.
        hot_start: `(keys, networks, episodes, groups, data, n_demonstrations) -> networks`; None
            for a method without. `episodes` `[slots, E]` are those of `data` that each seed draws
            its own from. It keeps its latest answer, which the next method asks for again.
        init: `(keys, networks, episodes, first, groups, data, n_demonstrations) -> TrainingState`
            `[slots, ...]`.
        first: `(keys [slots]) -> start or None`: the first observations of a task on the host; None
            for a task in JAX, whose `init` resets it.
        run: `(state, groups, data, steps, max_episodes) -> (TrainingState, Log)`; the state is
            donated. Only the first `groups` groups of slots on each device are stepped.
        resume: `(state, step) -> state`: goes on from a checkpoint before step number `step`.
        permute: `(state, move [slots]) -> TrainingState`: slot i takes the seed of slot move[i].
            The state is donated.
        evaluator: noise-free rollouts.
        slots: how many seeds the state has room for.
        group: slots that are stepped together on a device.
        devices: devices that share the slots.
        sharding: how the slots lie on them.
    """

    draw_networks: Callable[[jax.Array, int], Any]
    hot_start: Callable[..., Any] | None
    init: Callable[..., TrainingState]
    first: Callable[[jax.Array], Any]
    run: Callable[..., tuple[TrainingState, Log]]
    resume: Callable[[TrainingState, int], TrainingState]
    permute: Callable[[TrainingState, np.ndarray], TrainingState]
    evaluator: Evaluator
    slots: int
    group: int
    devices: int
    sharding: jax.sharding.Sharding


def compile_networks(
    env: Env | HostEnv, devices: Sequence[Any], architecture: Architecture, group: int
) -> Callable[[jax.Array, int], Any]:
    """Jit the drawing of the networks that every method starts from: `(keys, groups) -> networks`.

    Apart from `compile_method`: drawing them takes most of the time that an `init` compiles.
    """
    trainer = training.make(env, METHODS["ddpg"], Settings(architecture=architecture), capacity=1)
    drawn = seeds.step_groups(lambda key: (key, trainer.draw_networks(key)), group)

    def draw(keys: jax.Array, groups: int) -> Any:
        return seeds.map_devices(drawn, devices)(keys, groups)[1]

    return compilation.jit(draw, out_shardings=seeds.sharding(devices))


def compile_hot_start(
    env: Env | HostEnv,
    devices: Sequence[Any],
    subset_size: int | None,
    settings: Settings,
    group: int,
) -> Callable[..., Any]:
    """Jit the hot start, which all methods that have one share; see `CompiledMethod.hot_start`."""
    trainer = training.make(env, METHODS["bc"], settings, capacity=1, subset_size=subset_size)

    def of_seed(seed: tuple[jax.Array, Any, Any], data: HotStartData, n_demos: int):
        key, networks, episodes = seed
        return seed, trainer.hot_start(key, data._replace(episodes=episodes), n_demos, networks)

    def fit(
        keys: jax.Array,
        networks: Any,
        episodes: DemonstrationSubset,
        groups: int,
        data: HotStartData,
        n_demos: int,
    ) -> Any:
        spread = seeds.map_devices(seeds.step_groups(of_seed, group), devices)
        return spread((keys, networks, episodes), groups, data, n_demos)[1]

    return _Latest(compilation.jit(fit, out_shardings=seeds.sharding(devices)))


class _Latest:
    """A compiled hot start that gives its latest answer again to an equal question."""

    def __init__(self, fit: Callable[..., Any]):
        self._fit = fit
        self._question: Any = None
        self._data: HotStartData | None = None
        self._answer: Any = None

    def __call__(
        self,
        keys: jax.Array,
        networks: Any,
        episodes: DemonstrationSubset,
        groups: int,
        data: HotStartData,
        n_demos: int,
    ) -> Any:
        # The keys decide the networks too, and with the data the episodes.
        question = (np.asarray(jax.random.key_data(keys)).tobytes(), groups, n_demos)
        if question != self._question or data is not self._data:
            self._answer = self._fit(keys, networks, episodes, groups, data, n_demos)
            self._question, self._data = question, data
        return self._answer


def compile_method(
    env: Env | HostEnv,
    method: Method,
    settings: Settings,
    evaluator: Evaluator,
    draw_networks: Callable[[jax.Array, int], Any],
    hot_start: Callable[..., Any] | None,
    *,
    group: int,
    seeds_count: int,
    devices: Sequence[Any],
    capacity: int,
    subset_size: int | None,
    vectors: Sequence[Callable[[int], VectorEnv]] | None,
) -> CompiledMethod:
    """Jit a method's training, over seeds in groups and over devices. Compiles at first use.

    `vectors` make the sub-environments of a task on the host, one for each device.
    """
    trainer = training.make(env, method, settings, capacity=capacity, subset_size=subset_size)

    def spread(function: Callable) -> Callable:
        return seeds.map_devices(seeds.step_groups(function, group), devices)

    # The same sharding everywhere: JAX compiles again for another one, even if it is equivalent.
    split = seeds.sharding(devices)
    slots = seeds.padded(seeds_count, group, len(devices))
    if vectors is not None:
        of_device = [functools.partial(vector, slots // len(devices)) for vector in vectors]
        steps = host.Steps(trainer, env.spec, of_device, devices)
        first, run, resume = steps.first, steps.run, steps.resume
    else:
        first, resume = lambda keys: None, lambda state, step: state
        run = compilation.jit(spread(trainer.run), donate_argnums=0, out_shardings=split)
    init = functools.partial(_init, spread(functools.partial(_init_seed, trainer)))
    return CompiledMethod(
        draw_networks=draw_networks,
        hot_start=hot_start,
        init=compilation.jit(init, out_shardings=split),
        first=first,
        run=run,
        resume=resume,
        permute=jax.jit(_permute, donate_argnums=0, out_shardings=split),
        evaluator=evaluator,
        slots=slots,
        group=group,
        devices=len(devices),
        sharding=split,
    )


def _init(
    init_seeds: Callable[..., tuple[Any, TrainingState]],
    keys: jax.Array,
    networks: Any,
    episodes: DemonstrationSubset | None,
    first: Any,
    groups: int,
    data: HotStartData | None,
    n_demos: int,
) -> TrainingState:
    return init_seeds((keys, networks, episodes, first), groups, data, n_demos)[1]


def _init_seed(
    trainer: Trainer,
    seed: tuple[jax.Array, Any, DemonstrationSubset | None, Any],
    data: HotStartData | None,
    n_demos: int,
) -> tuple[Any, TrainingState]:
    """One seed's state, as the output of a step that leaves the seed's arguments as they are."""
    key, networks, episodes, first = seed
    data = None if data is None else data._replace(episodes=episodes)
    return seed, trainer.init(key, data, n_demos, networks, first)


def _permute(state: TrainingState, move: np.ndarray) -> TrainingState:
    return jax.tree.map(lambda leaf: leaf[move], state)


def begin(
    programs: CompiledMethod,
    slots: Slots,
    key: jax.Array,
    data: HotStartData | None,
    n_demos: int,
    first_seed: int = 0,
) -> TrainingState:
    """Initialise the seeds in `slots`, of which the first is number `first_seed` of the study.

    The idle slots hold further seeds, which are never looked at.
    """
    groups = slots.groups(np.ones(slots.seeds, bool))
    keys = seeds.keys(key, first_seed + programs.slots)[first_seed:][slots.seed]
    episodes = None if data is None else pools.episodes_of(data, first_seed + slots.seed)
    networks = programs.draw_networks(keys, groups)
    if programs.hot_start is not None:
        networks = programs.hot_start(keys, networks, episodes, groups, data, n_demos)
    return programs.init(keys, networks, episodes, programs.first(keys), groups, data, n_demos)


def abstract(programs: CompiledMethod, data: HotStartData | None, n_demos: int) -> TrainingState:
    """The shapes and dtypes of what `begin` makes."""
    keys = seeds.keys(jax.random.key(0), programs.slots)
    episodes = None if data is None else pools.episodes_of(data, np.arange(programs.slots))
    # One after the other: JAX refuses compiler options within another tracing.
    networks = jax.eval_shape(programs.draw_networks, keys, 1)
    return jax.eval_shape(
        programs.init, keys, networks, episodes, programs.first(keys), 1, data, n_demos
    )


def pack(
    programs: CompiledMethod, slots: Slots, state: TrainingState, active: np.ndarray
) -> tuple[TrainingState, int]:
    """Bring the seeds `active` `[seeds]` to the front; how many groups hold them now."""
    move = slots.pack(active)
    if move is not None:
        state = programs.permute(state, move)
    return state, slots.groups(active)


def compiler(
    env: Env | HostEnv,
    devices: Sequence[Any],
    *,
    capacity: int,
    subset_size: int | None,
    least_slots: int = 0,
    group: int | None = None,
    gather: Callable[[Any], Any] = ALONE.gather,
) -> Callable[[Method, Settings, int], CompiledMethod]:
    """A function that compiles a method for a number of seeds, once for all cells that share it.

    Args:
        env: the task.
        devices: that share the seeds.
        capacity: transitions in a replay where the settings leave it open.
        subset_size: the largest number of demonstrations of a seed; None without any.
        least_slots: seeds that there is room for at least, so that experts share a program.
        group: seeds that are stepped together on a device; None: what is fastest.
        gather: arrays of all devices as numpy.

    Returns:
        `(method, settings, seeds) -> CompiledMethod`. The group depends on these seeds alone, and
        so do a cell's numbers, whatever else is trained beside it.
    """
    on_host = isinstance(env, HostEnv)
    # Cells follow each other, and share the sub-environments that they train in.
    vectors = [host.Latest(env.vector) for _ in devices] if isinstance(env, HostEnv) else None

    # What methods share.
    evaluator = functools.cache(functools.partial(_evaluator, env, devices, gather))
    draw_networks = functools.cache(functools.partial(compile_networks, env, devices))
    hot_start = functools.cache(functools.partial(compile_hot_start, env, devices, subset_size))

    @functools.cache
    def compile_once(method: Method, settings: Settings, count: int) -> CompiledMethod:
        architecture = settings.architecture
        size = group
        if on_host:
            # One step of a task on the host is too short for groups to pay off.
            size = -(-count // len(devices))
        elif size is None:
            size = seeds.group_size(count, len(devices), architecture.hidden)
        return compile_method(
            env,
            method,
            settings,
            evaluator(architecture, size),
            draw_networks(architecture, size),
            hot_start(settings, size) if method.hot_start else None,
            group=size,
            seeds_count=count if on_host else max(count, least_slots),
            devices=devices,
            capacity=capacity,
            subset_size=subset_size,
            vectors=vectors,
        )

    return compile_once


def _evaluator(
    env: Env | HostEnv,
    devices: Sequence[Any],
    gather: Callable[[Any], Any],
    architecture: Architecture,
    group: int,
) -> Evaluator:
    if isinstance(env, HostEnv):
        return host.evaluator(env, architecture, gather)
    return evaluator_lib.of_networks(env, architecture, group, devices, gather)
