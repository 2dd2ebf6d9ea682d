"""The plot of how cost grows."""

from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("agg")
from matplotlib import pyplot as plt


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
    figure, axes = plt.subplots(1, 3, figsize=(12, 3.6), constrained_layout=True)
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
        axis.set(xscale="log", yscale="log", xlabel=label, ylabel="seconds for 12,000 steps")
        if axis.lines:
            axis.legend()
    figure.suptitle("DDPG on one core; 100 seeds, (64, 64), batch 32 where not said otherwise")
    figure.savefig(path, dpi=150)
    plt.close(figure)


def _standard(record: dict[str, Any]) -> bool:
    return record["suite"] == "seeds" and record["seeds"] == 100
