"""Where a run's time goes: seconds by phase, which the run prints at its end."""

import contextlib
import time
from collections.abc import Iterator
from typing import Literal

import jax

from cmedirl_jax.runs.console import compile_cache

Phase = Literal["beginning", "training", "evaluation", "demonstrations", "Gymnasium", "saving"]

_EVENT = "/cmedirl_jax/phase/"


@contextlib.contextmanager
def phase(name: Phase) -> Iterator[None]:
    """Report the time of this block to `counted`, without that of compiling in it.

    Phases do not nest. The block must wait for what it computes: JAX returns before it is done.
    """
    began = time.perf_counter()
    with compile_cache.counted() as cost:
        yield
    # What compiling took is an upper bound.
    seconds = max(0.0, time.perf_counter() - began - cost.seconds)
    jax.monitoring.record_event_duration_secs(_EVENT + name, seconds)


@contextlib.contextmanager
def counted() -> Iterator[dict[str, float]]:
    """Sum the seconds of each phase while this block runs."""
    seconds: dict[str, float] = {}

    def spent(event: str, duration_secs: float, **_: str | int) -> None:
        if event.startswith(_EVENT):
            name = event.removeprefix(_EVENT)
            seconds[name] = seconds.get(name, 0.0) + duration_secs

    jax.monitoring.register_event_duration_secs_listener(spent)
    try:
        yield seconds
    finally:
        jax.monitoring.unregister_event_duration_listener(spent)
