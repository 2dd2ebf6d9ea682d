"""`python -m benchmarks.seeds_per_second`: how many seeds a second, against a plain reference.

Every number comes from workloads that are timed in turn, so that the ratios hold on a machine whose
speed drifts. A workload of one device runs on one core.
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
from rich.console import Console
from rich.table import Table

from benchmarks import measuring, plots
from benchmarks.measuring import Comparison
from benchmarks.workload import Workload
from cmedirl_jax.training.methods import PAPER_METHODS

SEEDS = (1, 8, 32, 100, 1000)
WIDTHS = ((64, 64), (128, 128), (400, 300))


@dataclasses.dataclass(frozen=True)
class Options:
    """What to measure, and where to write it.

    Attributes:
        quick: DDPG at 100 seeds alone, on one device and on all: within a minute.
        suites: Only these parts of the whole: seeds, width, batch, method, scale, devices, ended,
            demonstrations, group, compilation.
        methods: Only these methods.
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
    """Workloads that are timed in turn; `ratios` names pairs of them by position."""

    name: str
    workloads: list[Workload]
    ratios: list[tuple[str, int, int]]


def suites(devices: int, methods: Sequence[str], quick: bool) -> Iterator[Suite]:
    """All there is to measure, in parts."""
    ours, naive = Workload(), Workload("naive")
    everywhere = dataclasses.replace(ours, devices=devices)
    if quick:
        workloads = [ours, naive] + [everywhere] * (devices > 1)
        ratios = [("ours / naive", 0, 1), (f"{devices} devices / 1", 2, 0)]
        yield Suite("quick", workloads, ratios[: len(workloads) - 1])
        return
    for method, seeds in itertools.product(methods, SEEDS):
        pair = [Workload(variant, method, seeds) for variant in ("ours", "naive")]
        yield Suite("seeds", pair, [(f"ours / naive, {method}, {seeds} seeds", 0, 1)])
    for hidden, layer_norm in itertools.product(WIDTHS, (False, True)):
        pair = [
            Workload(variant, hidden=hidden, layer_norm=layer_norm) for variant in ("ours", "naive")
        ]
        name = f"ours / naive, width {hidden}{', layer norm' * layer_norm}"
        yield Suite("width", pair, [(name, 0, 1)])
    pair = [Workload(variant, batch=128) for variant in ("ours", "naive")]
    yield Suite("batch", pair, [("ours / naive, batch 128", 0, 1)])
    beside = [method for method in methods if method != "ddpg"]
    yield Suite(
        "method",
        [ours, *(Workload(method=name) for name in beside), Workload(layer_norm=True)],
        [
            *((f"cost of {name} / ddpg", 0, i) for i, name in enumerate(beside, start=1)),
            ("cost of layer norm / none", 0, len(beside) + 1),
        ],
    )
    yield Suite("scale", [ours, Workload(seeds=1000)], [("1,000 seeds / 100 seeds", 1, 0)])
    if devices > 1:
        for method in methods:
            one = Workload(method=method)
            pair = [dataclasses.replace(one, devices=devices), one]
            yield Suite("devices", pair, [(f"{devices} devices / 1, {method}", 0, 1)])
    yield Suite(
        "ended",
        [Workload(running=0.2), ours],
        [("rate with 20% of the seeds running / all", 0, 1)],
    )
    demonstrated = [Workload(method="me-ddpg", n_demos=count) for count in (1, 10, 100, 1000)]
    names = [f"cost with {workload.n_demos} demonstrations / 1" for workload in demonstrated]
    yield Suite("demonstrations", demonstrated, [(names[i], 0, i) for i in range(1, 4)])
    for hidden in WIDTHS:
        sizes = (1, 2, 4, 5, 10, 20, 50, 100) if hidden[0] == 64 else (1, 2, 5, 10)
        groups = [Workload(hidden=hidden, group=size) for size in sizes]
        ratios = [(f"width {hidden}, groups of {size} / 1", i, 0) for i, size in enumerate(sizes)]
        yield Suite("group", groups, ratios[1:])


def compilation_times(methods: Sequence[str]) -> list[dict[str, Any]]:
    """What compiling each method costs with an empty cache, and with one that holds it."""
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for method, cache in itertools.product(methods, ("cold", "warm")):
            workload = Workload(method=method, devices=measuring.cores())
            worker = measuring.start(workload, 250, JAX_COMPILATION_CACHE_DIR=folder)
            seconds = worker.facts["compile_seconds"]
            worker.stop()
            found.append({"method": method, "cache": cache, "compile_seconds": seconds})
    return found


def main(options: Options) -> int:
    """Measure, print and write."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    devices = options.devices or measuring.cores()
    rounds = options.rounds or (3 if options.quick else 5)
    everything = list(suites(devices, options.methods, options.quick))
    names = list(dict.fromkeys([suite.name for suite in everything] + ["compilation"]))
    for option, asked, known in (
        ("suites", options.suites, names),
        ("methods", options.methods, PAPER_METHODS),
    ):
        for name in asked:
            if name not in known:
                message = (
                    f"--{option}: unknown {option[:-1]} {name!r}; there are {', '.join(known)}"
                )
                print(f"seeds_per_second: {message}", file=sys.stderr)
                return 2
    result: dict[str, Any] = {
        **measuring.heading("seeds_per_second"),
        "records": [],
        "comparisons": [],
        "compilation": [],
    }
    for suite in everything:
        if options.suites and suite.name not in options.suites:
            continue
        found = measuring.measure(suite.workloads, rounds, compile_together=options.quick)
        result["records"] += [{"suite": suite.name, **record.fields()} for record in found]
        for name, above, below in suite.ratios:
            ratio = measuring.compare(suite.name, name, found[above].rates, found[below].rates)
            console.print(_line(ratio), highlight=False, soft_wrap=True)
            result["comparisons"].append(dataclasses.asdict(ratio))
        # After each suite: the whole takes most of an hour, and none of it should be lost.
        write(result, options.json)
    if "compilation" in (options.suites or ("compilation",)) and not options.quick:
        result["compilation"] = compilation_times(options.methods)
        write(result, options.json)
    console.print(table(result["records"]))
    return 0


def write(result: dict[str, Any], path: Path | None) -> None:
    """Write the measurements so far, and draw what there is."""
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
    sys.exit(main(tyro.cli(Options, prog="python -m benchmarks.seeds_per_second")))
