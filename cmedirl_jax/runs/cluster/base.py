"""The processes that share a run: their interface, and its form for a single process."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol

import jax
import numpy as np

from cmedirl_jax.data.demonstrations import Demonstrations


class ClusterOptions(NamedTuple):
    """Which processes share a run.

    Attributes:
        distributed: those of the cluster that JAX detects.
        coordinator: HOST:PORT of process 0, or None.
        processes: how many there are, with `coordinator`.
        process_id: which of them this is, with `coordinator`.
    """

    distributed: bool = False
    coordinator: str | None = None
    processes: int | None = None
    process_id: int | None = None

    @property
    def several(self) -> bool:
        """Whether the run has several processes, of which this is one."""
        return self.distributed or self.coordinator is not None


class Cluster(Protocol):
    """The processes of one run.

    Every process runs the same program on the same values: what the host decides from comes from
    `gather`, or from process 0 by one of the `..._from_writer`. Process 0 alone prints, and reads
    and writes the run's folder. With several processes each method is a collective, except `call`.
    """

    @property
    def writer(self) -> bool:
        """Whether this process prints and writes."""
        ...

    def check_same(self, options: dict[str, Any]) -> None:
        """Check that every process was started with the same options, JSON values.

        Raises:
            UserError: on every process, if one was not.
        """
        ...

    def devices(self, count: int | None, seeds: int) -> list[Any]:
        """The devices that share the seeds: `count` of each process, or all that are of use."""
        ...

    def any(self, flag: bool) -> bool:
        """Whether `flag` is set on any process."""
        ...

    def gather(self, tree: Any) -> Any:
        """Arrays that may lie on the devices of several processes, as numpy on each process."""
        ...

    def from_writer(self, read: Callable[[], Any]) -> Any:
        """The JSON value that `read` returns on process 0, on every process.

        Raises:
            UserError: on every process, if `read` raised it.
        """
        ...

    def arrays_from_writer(self, arrays: Sequence[np.ndarray] | None) -> list[np.ndarray]:
        """Process 0's arrays, on every process; the others' argument is ignored."""
        ...

    def pool_from_writer(self, read: Callable[[], Demonstrations | None]) -> Demonstrations | None:
        """The demonstrations that `read` returns on process 0, on every process."""
        ...

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of orbax on this process, without waiting for the others."""
        ...


class Alone:
    """The cluster of a run with one process: there is nothing to exchange."""

    writer = True

    def check_same(self, options: dict[str, Any]) -> None:
        """Accept them."""

    def devices(self, count: int | None, seeds: int) -> list[Any]:
        """The first `count` devices of this process, or all."""
        del seeds
        return jax.local_devices()[:count]

    def any(self, flag: bool) -> bool:
        """Return `flag`."""
        return flag

    def gather(self, tree: Any) -> Any:
        """The same arrays as numpy."""
        return jax.tree.map(np.asarray, tree)

    def from_writer(self, read: Callable[[], Any]) -> Any:
        """Return what `read` returns."""
        return read()

    def arrays_from_writer(self, arrays: Sequence[np.ndarray] | None) -> list[np.ndarray]:
        """Return the arrays."""
        assert arrays is not None
        return list(arrays)

    def pool_from_writer(self, read: Callable[[], Demonstrations | None]) -> Demonstrations | None:
        """Return what `read` returns."""
        return read()

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call it."""
        return function(*arguments)


ALONE = Alone()
