"""What the processes of one run tell each other; docs/scaling.md.

Every process runs the same program on the same values: whatever the host decides from comes from
`gather`, or from process 0 by `from_writer`. Process 0 alone prints, and touches the run's folder.
"""

import dataclasses
import functools
import io
import json
from collections.abc import Callable, Sequence
from typing import Any

import jax
import numpy as np

from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.training import seeds
from cmedirl_jax.types import Transition

_BLOCK, _PIECE = 2**12, 2**26
"""Bytes are sent in pieces, the last in whole blocks, so that few sizes are compiled."""


def check_same(config: StudyConfig) -> None:
    """See that every process was started with the same options. A collective.

    Raises:
        UserError: on every process, if one was not.
    """
    mine = json.loads(json.dumps(dataclasses.asdict(config), default=str))
    writers = from_writer(lambda: mine)
    own = ("out", "coordinator", "process_id")
    other = [name for name in mine if name not in own and mine[name] != writers[name]]
    if any_process(bool(other)):
        here = ", ".join(other) or "another process"
        raise UserError(f"--process-id: not all processes were given the same options ({here})")


def is_writer() -> bool:
    """Whether this process prints and writes."""
    return jax.process_index() == 0


def devices(count: int | None, seeds_count: int) -> list[jax.Device]:
    """The devices of all processes, those of one process side by side.

    Args:
        count: devices of each process, or None for all that get four seeds or more.
        seeds_count: seeds that share them.
    """
    if count is None:
        count = max(1, seeds_count // (4 * jax.process_count()))
    return [
        device for process in range(jax.process_count()) for device in _of_process(process)[:count]
    ]


def _of_process(process: int) -> list[jax.Device]:
    found = [device for device in jax.devices() if device.process_index == process]
    return sorted(found, key=lambda device: device.id)


def connect(devices: Sequence[jax.Device]) -> None:
    """Connect devices of all processes, which wait for each other 30 seconds at most.

    Early, while the processes are together: compiling takes some of them longer than others.
    """
    split = seeds.sharding(devices)
    gather(jax.device_put(np.zeros(len(devices), np.int32), split))


def gather(tree: Any) -> Any:
    """Arrays that lie on the devices of all processes, whole as numpy on each process.

    A collective, unless everything lies on this process's devices.
    """
    leaves, structure = jax.tree.flatten(tree)
    spread = {
        index: leaf
        for index, leaf in enumerate(leaves)
        if isinstance(leaf, jax.Array) and not leaf.is_fully_addressable
    }
    if spread:
        mesh = next(iter(spread.values())).sharding.mesh
        whole = _replicate(mesh)(spread)
        leaves = [whole.get(index, leaf) for index, leaf in enumerate(leaves)]
    return jax.tree.unflatten(structure, [np.asarray(leaf) for leaf in leaves])


@functools.cache
def _replicate(mesh: jax.sharding.Mesh) -> Callable[[Any], Any]:
    return jax.jit(lambda tree: tree, out_shardings=jax.sharding.NamedSharding(mesh, jax.P()))


def any_process(flag: bool) -> bool:
    """Whether `flag` is set on any process. A collective, if there are several."""
    return flag if jax.process_count() == 1 else bool(_total(np.int32([flag])).any())


def from_writer(read: Callable[[], Any]) -> Any:
    """What `read` gives on process 0, a JSON value, on every process.

    A collective, if there are several.

    Raises:
        UserError: on every process, if `read` raised it.
    """
    if jax.process_count() == 1:
        return read()
    message, error = {}, None
    if is_writer():
        try:
            message = {"value": read()}
        except UserError as raised:
            message, error = {"error": str(raised)}, raised
    message = json.loads(_from_writer(json.dumps(message).encode()))
    if "error" in message:
        raise UserError(message["error"]) from error
    return message["value"]


def arrays_from_writer(arrays: Sequence[np.ndarray] | None) -> list[np.ndarray]:
    """Process 0's numpy arrays, on every process; the others' argument is ignored. A collective."""
    if jax.process_count() == 1:
        assert arrays is not None
        return list(arrays)
    buffer = io.BytesIO()
    if is_writer():
        assert arrays is not None
        np.savez(buffer, allow_pickle=False, **{str(i): array for i, array in enumerate(arrays)})
    with np.load(io.BytesIO(_from_writer(buffer.getvalue())), allow_pickle=False) as file:
        return [file[str(index)] for index in range(len(file.files))]


def pool_from_writer(read: Callable[[], Demonstrations | None]) -> Demonstrations | None:
    """As `from_writer`, for a pool of demonstrations."""
    held: list[Demonstrations | None] = [None]

    def metadata() -> Any:
        held[0] = read()
        return None if held[0] is None else held[0].metadata

    if jax.process_count() == 1:
        return read()
    found = from_writer(metadata)
    if found is None:
        return None
    pool = held[0]
    mine = None if pool is None else [*pool.transition, pool.truncated, pool.episode]
    *transition, truncated, episode = arrays_from_writer(mine)
    return Demonstrations(Transition(*transition), truncated, episode, found)


def _from_writer(data: bytes) -> bytes:
    """Process 0's bytes, on every process."""
    if not is_writer():
        data = b""
    pieces, rest = (int(part) for part in _total(np.int32(divmod(len(data), _PIECE))))
    whole = np.zeros(pieces * _PIECE + -(-rest // _BLOCK) * _BLOCK, np.uint8)
    whole[: len(data)] = np.frombuffer(data, np.uint8)
    for start in range(0, whole.size, _PIECE):
        whole[start : start + _PIECE] = _total(whole[start : start + _PIECE])
    return whole[: pieces * _PIECE + rest].tobytes()


def _total(mine: np.ndarray) -> np.ndarray:
    """The sum over processes of arrays of one shape."""
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
