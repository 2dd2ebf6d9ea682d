"""`python -m benchmarks.seeds_per_second`: how many seeds a second, against a plain reference.

Workloads are timed in turn, so that their ratios hold on a machine whose speed drifts. A workload
of one device runs on one core.
"""

import dataclasses
import itertools
import sys
import tempfile
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tyro
from rich import box
from rich.table import Table

from benchmarks import measuring, plots
from benchmarks.measuring import Comparison
from benchmarks.workload import Workload
from cmedirl_jax.runs.console import ending, screen
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs
from cmedirl_jax.training.methods import PAPER_METHODS

SEEDS = (1, 8, 32, 100, 1000)
SCALE = (1, 10, 100, 1_000, 10_000)
"""Seeds of the suite that looks at nothing else."""
WIDTHS = ((64, 64), (128, 128), (400, 300))


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure, and where to write it.

    Attributes:
        quick: DDPG at 100 seeds alone, on one device and on all: about a minute.
        suites: Parts to measure: seeds, width, batch, method, scale, devices, ended,
            demonstrations, group, compilation; default: all.
        methods: Methods to measure.
        devices: Devices of the workloads that use several; default: every core, or every GPU.
        rounds: How often each workload is timed; default 5, with --quick 3.
        json: File for the measurements; a plot is drawn beside it.
    """

    quick: bool = False
    suites: tuple[str, ...] = ()
    methods: tuple[str, ...] = PAPER_METHODS
    devices: int | None = None
    rounds: int | None = None
    json: Path | None = None


class Suite(NamedTuple):
    """Workloads that are timed in turn.

    Attributes:
        name: of the suite.
        workloads: what is timed.
        ratios: name, and positions of the workloads whose rates are divided.
    """

    name: str
    workloads: list[Workload]
    ratios: list[tuple[str, int, int]]


def suites(devices: int, methods: Sequence[str], quick: bool) -> Iterator[Suite]:
    """Everything there is to measure, in parts.

    Args:
        devices: of the workloads that use several.
        methods: names of methods.
        quick: DDPG at 100 seeds alone.
    """
    if quick:
        yield _quick(devices)
        return
    # Ours against the naive reference.
    for method, seeds in itertools.product(methods, SEEDS):
        yield _against_naive("seeds", f"{method}, {seeds} seeds", method=method, seeds=seeds)
    for hidden, layer_norm in itertools.product(WIDTHS, (False, True)):
        name = f"width {hidden}{', layer norm' * layer_norm}"
        yield _against_naive("width", name, hidden=hidden, layer_norm=layer_norm)
    yield _against_naive("batch", "batch 128", batch=128)

    # Ours against ours: what costs what.
    ours = Workload()
    yield _methods(methods)
    at_100 = SCALE.index(100)
    ratios = [(f"{seeds:,} seeds / 100 seeds", i, at_100) for i, seeds in enumerate(SCALE)]
    del ratios[at_100]
    yield Suite("scale", [Workload(seeds=seeds) for seeds in SCALE], ratios)
    if devices > 1:
        for method in methods:
            one = Workload(method=method)
            pair = [dataclasses.replace(one, devices=devices), one]
            yield Suite("devices", pair, [(f"{devices} devices / 1, {method}", 0, 1)])
    ratio = ("rate with 20% of the seeds running / all", 0, 1)
    yield Suite("ended", [Workload(running=0.2), ours], [ratio])
    demonstrated = [Workload(method="me-ddpg", n_demos=count) for count in (1, 10, 100, 1000)]
    names = [f"cost with {workload.n_demos} demonstrations / 1" for workload in demonstrated]
    yield Suite("demonstrations", demonstrated, [(names[i], 0, i) for i in range(1, 4)])
    for hidden in WIDTHS:
        sizes = (1, 2, 4, 5, 10, 20, 50, 100) if hidden[0] == 64 else (1, 2, 5, 10)
        groups = [Workload(hidden=hidden, group=size) for size in sizes]
        ratios = [(f"width {hidden}, groups of {size} / 1", i, 0) for i, size in enumerate(sizes)]
        yield Suite("group", groups, ratios[1:])


def _quick(devices: int) -> Suite:
    ours = Workload()
    everywhere = dataclasses.replace(ours, devices=devices)
    workloads = [ours, Workload("naive")] + [everywhere] * (devices > 1)
    ratios = [("ours / naive", 0, 1), (f"{devices} devices / 1", 2, 0)]
    return Suite("quick", workloads, ratios[: len(workloads) - 1])


def _against_naive(suite: str, name: str, **sizes: Any) -> Suite:
    pair = [Workload("ours", **sizes), Workload("naive", **sizes)]
    return Suite(suite, pair, [(f"ours / naive, {name}", 0, 1)])


def _methods(methods: Sequence[str]) -> Suite:
    beside = [method for method in methods if method != "ddpg"]
    workloads = [*(Workload(method=name) for name in beside), Workload(layer_norm=True)]
    costs = [*(f"cost of {name} / ddpg" for name in beside), "cost of layer norm / none"]
    ratios = [(name, 0, i) for i, name in enumerate(costs, start=1)]
    return Suite("method", [Workload(), *workloads], ratios)


def compilation_times(methods: Sequence[str]) -> list[dict[str, Any]]:
    """Seconds to compile each method with an empty cache, and with one that holds it."""
    times = []
    with tempfile.TemporaryDirectory() as folder:
        for method, cache in itertools.product(methods, ("cold", "warm")):
            workload = Workload(method=method, devices=measuring.cores())
            worker = measuring.start(workload, 250, JAX_COMPILATION_CACHE_DIR=folder)
            seconds = worker.facts["compile_seconds"]
            worker.stop()
            times.append({"method": method, "cache": cache, "compile_seconds": seconds})
    return times


@ending.in_a_line("seeds_per_second")
def main(options: Options) -> int:
    """Measure, print and write; returns the exit code."""
    outputs.check("json", options.json)
    console = screen.console()
    devices = options.devices or measuring.cores()
    rounds = options.rounds or (3 if options.quick else 5)
    everything = list(suites(devices, options.methods, options.quick))
    _check(options, everything)
    result: dict[str, Any] = {
        **measuring.heading("seeds_per_second"),
        "records": [],
        "comparisons": [],
        "compilation": [],
    }
    for suite in everything:
        if options.suites and suite.name not in options.suites:
            continue
        records = measuring.measure(suite.workloads, rounds, compile_together=options.quick)
        result["records"] += [{"suite": suite.name, **record.fields()} for record in records]
        for name, above, below in suite.ratios:
            ratio = measuring.compare(suite.name, name, records[above].rates, records[below].rates)
            screen.say(console, _line(ratio))
            result["comparisons"].append(dataclasses.asdict(ratio))
        # After each suite: the whole takes more than an hour, and an end in between keeps the rest.
        write(result, options.json)
    if "compilation" in (options.suites or ("compilation",)) and not options.quick:
        result["compilation"] = compilation_times(options.methods)
        write(result, options.json)
    screen.show(console, table(result["records"]))
    return 0


def _check(options: Options, everything: Sequence[Suite]) -> None:
    """Refuse names that are unknown."""
    suite_names = list(dict.fromkeys([suite.name for suite in everything] + ["compilation"]))
    for option, asked, known in (
        ("suites", options.suites, suite_names),
        ("methods", options.methods, PAPER_METHODS),
    ):
        for name in asked:
            if name not in known:
                there = ", ".join(known)
                raise UserError(f"--{option}: unknown {option[:-1]} {name!r}; there are {there}")


def write(result: dict[str, Any], path: Path | None) -> None:
    """Write the measurements so far, and draw them."""
    if path is not None:
        measuring.write(result, path)
        plots.growth(result["records"], path.with_suffix(".png"))


def table(records: list[dict[str, Any]]) -> Table:
    """The measurements, a row for each workload."""
    shown = Table(box=box.SIMPLE, title="medians; seeds of 12,000 steps")
    for name in (
        "method",
        "variant",
        "seeds",
        "devices",
        "width",
        "batch",
        "steps/s",
        "seeds/s",
        "compile s",
        "peak MB",
    ):
        shown.add_column(name, justify="left" if name in ("method", "variant") else "right")
    for record in records:
        width = "x".join(map(str, record["width"])) + " LN" * record["layer_norm"]
        memory = record["peak_memory_bytes"]
        shown.add_row(
            record["method"],
            record["variant"],
            f"{record['seeds']:,}",
            str(record["devices"]),
            width,
            str(record["batch"]),
            f"{record['learning_steps_per_second']:,.0f}",
            f"{record['seeds_per_second']:.3g}",
            f"{record['compile_seconds']:.1f}",
            "?" if memory is None else f"{memory / 1e6:,.0f}",
        )
    return shown


def _line(comparison: Comparison) -> str:
    return (
        f"{comparison.name}: {comparison.median:.2f} "
        f"({comparison.low:.2f} to {comparison.high:.2f} over the rounds)"
    )


if __name__ == "__main__":
    options = tyro.cli(Options, prog="python -m benchmarks.seeds_per_second", description=__doc__)
    sys.exit(main(options))
