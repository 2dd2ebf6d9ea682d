"""The processes that share a run: their interface, and its form for a single process."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

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


class Cluster:
    """The processes of one run. This class is the form for a single process: it exchanges nothing.

    Every process runs the same program on the same values: what the host decides from comes from
    `gather`, or from process 0 by one of the `..._from_writer`. Process 0 alone prints, and reads
    and writes the run's folder. With several processes each method is a collective, except `call`.
    """

    @property
    def writer(self) -> bool:
        """Whether this process prints and writes."""
        return True

    def check_same(self, options: dict[str, Any]) -> None:
        """Check that every process was started with the same options, JSON values.

        Raises:
            UserError: on every process, if one was not.
        """

    def devices(self, count: int | None, seeds: int) -> list[Any]:
        """The devices that share the seeds.

        Args:
            count: devices of each process, or None for all that are of use.
            seeds: how many seeds there are.
        """
        del seeds
        return jax.local_devices()[:count]

    def any(self, flag: bool) -> bool:
        """Whether `flag` is set on any process."""
        return flag

    def gather(self, tree: Any) -> Any:
        """Arrays that may lie on the devices of several processes, as numpy on each process."""
        return jax.tree.map(np.asarray, tree)

    def from_writer(self, read: Callable[[], Any]) -> Any:
        """The JSON value that `read` returns on process 0, on every process.

        Raises:
            UserError: on every process, if `read` raised it.
        """
        return read()

    def arrays_from_writer(self, arrays: Sequence[np.ndarray] | None) -> list[np.ndarray]:
        """Process 0's arrays, on every process; the others' argument is ignored."""
        assert arrays is not None
        return list(arrays)

    def pool_from_writer(self, read: Callable[[], Demonstrations | None]) -> Demonstrations | None:
        """The demonstrations that `read` returns on process 0, on every process."""
        return read()

    def call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function of orbax on this process, without waiting for the others."""
        return function(*arguments)


ALONE = Cluster()
