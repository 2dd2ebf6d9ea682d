"""Plots of the measurements."""

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np

matplotlib.use("agg")
from matplotlib import pyplot as plt
from matplotlib import ticker
from matplotlib.figure import Figure

from cmedirl_jax.io import atomic


def growth(records: list[dict[str, Any]], path: Path) -> None:
    """Seconds per 12,000 steps of all seeds against seeds, width and batch, one panel each."""
    panels = {
        "seeds": ("seeds", lambda record: record["seeds"]),
        "width": (
            "parameters of a hidden layer",
            lambda record: record["width"][0] * record["width"][1],
        ),
        "batch": ("batch", lambda record: record["batch"]),
    }
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), sharey=True, constrained_layout=True)
    for axis, (suite, (label, position)) in zip(axes, panels.items(), strict=True):
        for variant, style in (("ours", "o-"), ("naive", "s--")):
            chosen = [
                record
                for record in records
                if record["method"] == "ddpg"
                and record["variant"] == variant
                and not record["layer_norm"]
                and (record["suite"] == suite or (suite == "batch" and _standard(record)))
            ]
            points = sorted((position(r), r["seeds"] / r["seeds_per_second"]) for r in chosen)
            if points:
                axis.plot(*zip(*points, strict=True), style, label=variant)
        axis.set(xscale="log", yscale="log", xlabel=label)
        # Whole numbers, at the measured points: powers of ten read badly over so short an axis.
        measured = sorted({int(x) for line in axis.lines for x in np.asarray(line.get_xdata())})
        axis.set_xticks(measured, [f"{x:,}" for x in measured])
        axis.xaxis.set_minor_locator(ticker.NullLocator())
        if axis.lines:
            axis.legend()
    axes[0].set_ylabel("seconds for 12,000 steps")
    axes[0].yaxis.set_major_formatter(ticker.StrMethodFormatter("{x:,g}"))
    figure.suptitle("DDPG on one core; 100 seeds, (64, 64), batch 32 where not said otherwise")
    _save(figure, path)


def _standard(record: dict[str, Any]) -> bool:
    return record["suite"] == "seeds" and record["seeds"] == 100


def soak(samples: list[dict[str, Any]], path: Path) -> None:
    """Memory, files and threads of a process over time, and the cells it has finished."""
    minutes = [sample["seconds"] / 60 for sample in samples]
    panels = {
        "resident memory, MiB": [sample["resident_bytes"] / 2**20 for sample in samples],
        "open files": [sample["open_files"] for sample in samples],
        "threads": [sample["threads"] for sample in samples],
        "cells finished": [sample["cells"] for sample in samples],
    }
    figure, axes = plt.subplots(1, 4, figsize=(14, 3.2), constrained_layout=True)
    for axis, (label, values) in zip(axes, panels.items(), strict=True):
        axis.plot(minutes, values)
        axis.set(xlabel="minutes", ylabel=label, ylim=(0, None))
    _save(figure, path)


def _save(figure: Figure, path: Path) -> None:
    with atomic.replacing(path) as partial:
        figure.savefig(partial, format=path.suffix[1:], dpi=150)
    plt.close(figure)
