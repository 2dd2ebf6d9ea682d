"""Plots of the measurements. One that cannot be drawn is a line on standard error."""

import functools
from pathlib import Path
from typing import Any

import numpy as np

from cmedirl_jax.runs import drawing
from cmedirl_jax.runs.console import streams
from cmedirl_jax.runs.drawing import Figure

Records = list[dict[str, Any]]


def growth(records: Records, path: Path) -> None:
    """Seconds per 12,000 steps of all seeds against seeds, width and batch, one panel each."""
    drawing.save(functools.partial(_growth, records), [path], streams.complain)


def _growth(records: Records) -> Figure:
    panels = {
        "seeds": ("seeds", lambda record: record["seeds"]),
        "width": (
            "parameters of a hidden layer",
            lambda record: record["width"][0] * record["width"][1],
        ),
        "batch": ("batch", lambda record: record["batch"]),
    }
    figure = Figure(figsize=(12, 3.6), layout="constrained")
    axes = figure.subplots(1, 3, sharey=True)
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
        axis.xaxis.minorticks_off()
        if axis.lines:
            axis.legend()
    axes[0].set_ylabel("seconds for 12,000 steps")
    axes[0].yaxis.set_major_formatter("{x:,g}")
    figure.suptitle("DDPG on one core; 100 seeds, (64, 64), batch 32 where not said otherwise")
    return figure


def _standard(record: dict[str, Any]) -> bool:
    return record["suite"] == "seeds" and record["seeds"] == 100


def soak(samples: Records, path: Path) -> None:
    """Memory, files and threads of a process over time, and the cells it has finished."""
    drawing.save(functools.partial(_soak, samples), [path], streams.complain)


def _soak(samples: Records) -> Figure:
    minutes = [sample["seconds"] / 60 for sample in samples]
    panels = {
        "resident memory, MiB": [sample["resident_bytes"] / 2**20 for sample in samples],
        "open files": [sample["open_files"] for sample in samples],
        "threads": [sample["threads"] for sample in samples],
        "cells finished": [sample["cells"] for sample in samples],
    }
    figure = Figure(figsize=(14, 3.2), layout="constrained")
    axes = figure.subplots(1, 4)
    for axis, (label, values) in zip(axes, panels.items(), strict=True):
        axis.plot(minutes, values)
        axis.set(xlabel="minutes", ylabel=label, ylim=(0, None))
    return figure
