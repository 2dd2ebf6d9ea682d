"""A cell's training and evaluation on a task of the host, in the shape of the compiled ones."""

import functools
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from gymnasium.vector import VectorEnv

from cmedirl_jax import networks
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.envs import HostEnv, stepping
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.cells.evaluator import Evaluator
from cmedirl_jax.training import Log, Trainer, TrainingState, evaluation, host_loop
from cmedirl_jax.types import EnvSpec


class Latest:
    """The sub-environments that were made last."""

    def __init__(self, make: Callable[[int], VectorEnv]):
        """`make` makes so many of them."""
        self._make = make
        self._vector: VectorEnv | None = None

    def __call__(self, count: int) -> VectorEnv:
        """So many; others that were made before are closed."""
        if self._vector is None or self._vector.num_envs != count:
            if self._vector is not None:
                self._vector.close()
            self._vector = self._make(count)
        return self._vector


class Steps:
    """How the seeds of a method are stepped: `first`, `run` and `resume` of a `CompiledMethod`.

    Each device has a thread that steps its share of the seeds, the calling one for the first: while
    one waits for its simulator, another's updates run. A simulator's state is not in the training
    state, so that a checkpoint lacks it: training goes on from one at the start of an episode.
    """

    def __init__(
        self,
        trainer: Trainer,
        spec: EnvSpec,
        vectors: Sequence[Callable[[], VectorEnv]],
        devices: Sequence[Any],
    ):
        """The sub-environments, one a slot, are those that `vectors` make, one for each device."""
        self._vectors, self._devices = vectors, devices
        self._halves = host_loop.compile_halves(trainer, spec.max_episode_steps)

    def first(self, keys: jax.Array) -> tuple[None, np.ndarray]:
        """Begin the first episodes; the state, which is not here, and observations `[slots, O]`."""
        return None, self._reset(np.asarray(self._halves.first_seeds(keys)))

    def run(
        self,
        state: TrainingState,
        groups: int,
        data: HotStartData | None,
        steps: jax.Array,
        max_episodes: jax.Array | None,
    ) -> tuple[TrainingState, Log]:
        """Step every slot: one group is all that a device has."""
        del groups
        numbers = np.asarray(steps)
        # Not on the devices, each of which takes it.
        limit: Any = None if max_episodes is None else np.asarray(max_episodes)

        def step(device: Any, vector: Callable[[], VectorEnv]) -> tuple[TrainingState, Log]:
            own, pool = _on(device, state), _on(device, data)
            return host_loop.run(self._halves, vector(), own, pool, numbers, limit)

        # One device starts no thread: a task may want the main one.
        first, *others = zip(self._devices, self._vectors, strict=True)
        with ThreadPoolExecutor(len(self._devices)) as threads:
            stepping_others = [threads.submit(step, *share) for share in others]
            stepped = [step(*first), *(share.result() for share in stepping_others)]
        states, logs = zip(*stepped, strict=True)
        return _joined(state, states), jax.tree.map(lambda *leaves: np.concatenate(leaves), *logs)

    def resume(self, state: TrainingState, step: int) -> TrainingState:
        """Begin an episode in every slot."""
        before, now = np.int32(step - 1), np.int32(step)
        parts = [_on(device, state) for device in self._devices]
        numbers = [np.asarray(self._halves.seeds(part, before)) for part in parts]
        seen = np.split(self._reset(np.concatenate(numbers)), len(parts))
        begun = [self._halves.begin_episode(both, now) for both in zip(parts, seen, strict=True)]
        return _joined(state, begun)

    def _reset(self, numbers: np.ndarray) -> np.ndarray:
        """Reset every slot by its number `[slots]`: observations `[slots, O]`."""
        shares = np.split(numbers, len(self._vectors))
        return np.concatenate(
            [
                stepping.reset(vector(), share)
                for vector, share in zip(self._vectors, shares, strict=True)
            ]
        )


def _on(device: Any, tree: Any) -> Any:
    """What a device holds of arrays that are split among devices, or copied to all of them."""

    def local(leaf: Any) -> Any:
        if isinstance(leaf, jax.Array):
            for shard in leaf.addressable_shards:
                if shard.device == device:
                    # The only shard may be the array itself, whose mesh would compile once more.
                    return jax.device_put(shard.data, device)
        return leaf

    return jax.tree.map(local, tree)


def _joined(like: Any, parts: Sequence[Any]) -> Any:
    """The devices' parts as arrays that are split as `like` was."""

    def join(whole: jax.Array, *leaves: jax.Array) -> jax.Array:
        # The shape of a step's outputs is that of its inputs.
        return jax.make_array_from_single_device_arrays(whole.shape, whole.sharding, leaves)

    return jax.tree.map(join, like, *parts)


def evaluator(env: HostEnv, architecture: Architecture, gather: Callable[[Any], Any]) -> Evaluator:
    """An evaluator of actors of one architecture; the fixed starts are reset seeds 0, 1, ..."""
    act = functools.partial(networks.policy, networks.make(env.spec, architecture))
    act_all = jax.jit(jax.vmap(act))
    # As many sub-environments as there are policies.
    vector = Latest(env.vector)

    def play(actors: Any, starts: np.ndarray):
        # All on one device: a step is too short to share.
        actors = jax.device_put(gather(actors))
        count = jax.tree.leaves(actors)[0].shape[0]
        limit = env.spec.max_episode_steps
        return evaluation.rollout_on_host(
            lambda seen: act_all(actors, seen), vector(count), starts, limit
        )

    def on_starts(actors: Any, count: int, groups: int | None = None):
        del groups
        return play(actors, np.arange(count))

    def on_fresh_starts(actors: Any, key: jax.Array, count: int):
        return play(actors, np.asarray(jax.random.bits(key, (count,), jnp.uint32)))

    return Evaluator(on_starts, on_fresh_starts, act, gather)
