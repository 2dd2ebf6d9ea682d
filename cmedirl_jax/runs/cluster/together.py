"""The cluster of several processes, under JAX's multi-process runtime; docs/scaling.md."""

import functools
import io
import json
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.cluster import orbax_worker
from cmedirl_jax.runs.cluster.base import Cluster
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.training import seeds as seeds_lib
from cmedirl_jax.types import Transition

_BLOCK, _PIECE = 2**12, 2**26
"""Bytes are sent in pieces, the last in whole blocks, so that few sizes are compiled."""


class Together(Cluster):
    """Several processes, which have joined `jax.distributed`."""

    @property
    def writer(self) -> bool:
        """Whether this is process 0."""
        return jax.process_index() == 0

    def check_same(self, options: dict[str, Any]) -> None:
        """See `Cluster.check_same`."""
        mine = json.loads(json.dumps(options))
        writers = self.from_writer(lambda: mine)
        other = [name for name in mine if mine[name] != writers[name]]
        if self.any(bool(other)):
            here = ", ".join(other) or "another process"
            raise UserError(f"--process-id: not all processes were given the same options ({here})")

    def devices(self, count: int | None, seeds: int) -> list[Any]:
        """Those of one process side by side, connected; by default four seeds or more for each."""
        if count is None:
            count = max(1, seeds // (4 * jax.process_count()))
        every = range(jax.process_count())
        shared = [device for process in every for device in _of_process(process)[:count]]
        # The processes wait 30 seconds at most for a first exchange. They are together now, and
        # will not be when each has compiled for as long as its machine takes.
        self.gather(jax.device_put(np.zeros(len(shared), np.int32), seeds_lib.sharding(shared)))
        return shared

    def any(self, flag: bool) -> bool:
        """Whether `flag` is set on any process."""
        return bool(_total(np.array([flag], np.int32)).any())

    def gather(self, tree: Any) -> Any:
        """Arrays as numpy. Exchanges nothing where all lie on this process's devices."""
        leaves, structure = jax.tree.flatten(tree)
        spread = {
            index: leaf
            for index, leaf in enumerate(leaves)
            if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable
        }
        if spread:
            sharding = next(iter(spread.values())).sharding
            assert isinstance(sharding, jax.sharding.NamedSharding)
            whole = _replicate(sharding.mesh)(spread)
            leaves = [whole.get(index, leaf) for index, leaf in enumerate(leaves)]
        return jax.tree.unflatten(structure, [np.asarray(leaf) for leaf in leaves])

    def from_writer(self, read: Callable[[], Any]) -> Any:
        """See `Cluster.from_writer`."""
        message, error = {}, None
        if self.writer:
            try:
                message = {"value": read()}
            except UserError as raised:
                message, error = {"error": str(raised)}, raised
        message = json.loads(self._bytes_from_writer(json.dumps(message).encode()))
        if "error" in message:
            raise UserError(message["error"]) from error
        return message["value"]

    def arrays_from_writer(self, arrays: Sequence[np.ndarray] | None) -> list[np.ndarray]:
        """Process 0's arrays."""
        buffer = io.BytesIO()
        if self.writer:
            assert arrays is not None
            named = {str(index): array for index, array in enumerate(arrays)}
            np.savez(buffer, allow_pickle=False, **named)
        sent = self._bytes_from_writer(buffer.getvalue())
        with np.load(io.BytesIO(sent), allow_pickle=False) as file:
            return [file[str(index)] for index in range(len(file.files))]

    def pool_from_writer(self, read: Callable[[], Demonstrations | None]) -> Demonstrations | None:
        """The demonstrations that `read` returns on process 0."""
        mine: list[Demonstrations | None] = [None]

        def read_metadata() -> Any:
            mine[0] = read()
            return None if mine[0] is None else mine[0].metadata

        metadata = self.from_writer(read_metadata)
        if metadata is None:
            return None
        pool = mine[0]
        arrays = None if pool is None else [*pool.transition, pool.truncated, pool.episode]
        *transition, truncated, episode = self.arrays_from_writer(arrays)
        return Demonstrations(Transition(*transition), truncated, episode, metadata)

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of orbax in a process of its own, which no other waits for."""
        return orbax_worker.call(function, *arguments)

    def _bytes_from_writer(self, data: bytes) -> bytes:
        if not self.writer:
            data = b""
        lengths = np.array(divmod(len(data), _PIECE), np.int32)
        pieces, rest = (int(length) for length in _total(lengths))
        whole = np.zeros(pieces * _PIECE + -(-rest // _BLOCK) * _BLOCK, np.uint8)
        whole[: len(data)] = np.frombuffer(data, np.uint8)
        for start in range(0, whole.size, _PIECE):
            whole[start : start + _PIECE] = _total(whole[start : start + _PIECE])
        return whole[: pieces * _PIECE + rest].tobytes()


def _of_process(process: int) -> list[Any]:
    own = [device for device in jax.devices() if device.process_index == process]
    return sorted(own, key=lambda device: device.id)


@functools.cache
def _replicate(mesh: Any) -> Callable[[Any], Any]:
    return jax.jit(lambda tree: tree, out_shardings=jax.sharding.NamedSharding(mesh, jax.P()))


def _total(mine: np.ndarray) -> np.ndarray:
    """The sum over the processes of arrays of one shape."""
    split, add = _adder(jax.process_count())
    return np.asarray(add(jax.make_array_from_process_local_data(split, mine[None])))


@functools.cache
def _adder(processes: int) -> tuple[jax.sharding.NamedSharding, Callable[[jax.Array], jax.Array]]:
    firsts = np.asarray([_of_process(process)[0] for process in range(processes)])
    split = jax.sharding.NamedSharding(
        jax.sharding.Mesh(firsts, ("processes",)), jax.P("processes")
    )
    whole = split.update(spec=jax.P())
    return split, jax.jit(lambda stacked: stacked.sum(0, dtype=stacked.dtype), out_shardings=whole)
