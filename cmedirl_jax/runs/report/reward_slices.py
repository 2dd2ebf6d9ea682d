"""What learned rewards look at: the importance of each input, and slices through demonstrations."""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl

from cmedirl_jax.assess import importance
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.drawing import Figure
from cmedirl_jax.runs.report import curves
from cmedirl_jax.runs.report.reward_samples import Judged

STEPS, POINTS = 32, 41
"""Demonstrated steps of each seed that are sliced through, and points of a slice."""
MOST = 8
"""Inputs that are drawn: the most important ones."""


class Slice(NamedTuple):
    """A reward along one input, the others as they were demonstrated.

    Attributes:
        at: `[POINTS]`, values of the input, from its 1st to its 99th percentile.
        reward: `[seeds, POINTS]`, the mean over the demonstrated steps.
    """

    at: np.ndarray
    reward: np.ndarray


def inputs(env: Env | HostEnv) -> list[str]:
    """What a reward reads, in order."""
    sizes = (("observation", env.spec.observation_dim), ("action", env.spec.action_dim))
    return [f"{name}[{index}]" for name, size in sizes for index in range(size)]


def importances(judged: Judged) -> pl.DataFrame:
    """How much each reward depends on each input, on what its demonstrations and policy visit."""
    names, parts = inputs(judged.context.env), []
    for cell, sampled in judged.cells:
        rewards, key = Rewards(*cell.rewards()), cell.cell.key
        measure = jax.jit(
            lambda params, steps, pay=rewards.reward: importance.permutation(
                judged.context.key, Rewards(pay, params), steps
            )
        )
        found = np.asarray(measure(rewards.params, sampled.visited), np.float64)
        labels = {"method": [key.method] * key.seeds, "n_demos": [key.n_demos] * key.seeds}
        columns = dict(zip(names, found.T, strict=True))
        parts.append(pl.DataFrame(labels | {"seed": list(key.seed_range)} | columns))
    return pl.concat(parts)


def of_cell(rewards: Rewards, demonstrated: np.ndarray, column: int, size: int) -> Slice:
    """A slice along one input.

    Args:
        rewards: of the cell's seeds.
        demonstrated: `[seeds, N, O + A]`, demonstrated steps.
        column: which input.
        size: O.
    """
    low, high = np.percentile(demonstrated[..., column], [1.0, 99.0])
    at = np.linspace(low, high, POINTS, dtype=np.float32)
    steps = np.repeat(demonstrated[:, :STEPS, None], POINTS, axis=2)
    steps[..., column] = at
    paid = jax.jit(jax.vmap(rewards.reward))(rewards.params, steps[..., :size], steps[..., size:])
    return Slice(at, np.asarray(jnp.mean(paid, axis=1)))


def figure(judged: Judged, importances: pl.DataFrame) -> Callable[[], Figure]:
    """Draws a row for each cell and a column for each of the most important inputs."""
    spec, names = judged.context.env.spec, inputs(judged.context.env)
    mean = importances.select(names).mean().row(0)
    chosen = sorted(np.argsort(mean)[::-1][:MOST].tolist())

    def draw() -> Figure:
        drawn = Figure(
            figsize=(2.3 * len(chosen) + 1.0, 1.9 * len(judged.cells)), layout="constrained"
        )
        panels = drawn.subplots(
            len(judged.cells), len(chosen), sharex="col", sharey="row", squeeze=False
        )
        for row, (cell, sampled) in zip(panels, judged.cells, strict=True):
            rewards, (shown, _) = Rewards(*cell.rewards()), sampled.seen
            demonstrated = np.concatenate([shown.observation, shown.action], axis=-1)
            for axes, column in zip(row, chosen, strict=True):
                one = of_cell(rewards, demonstrated, column, spec.observation_dim)
                low, high = np.percentile(one.reward, [5.0, 95.0], axis=0)
                axes.fill_between(one.at, low, high, color=curves.COLOURS[0], alpha=0.2, lw=0)
                axes.plot(one.at, one.reward.mean(axis=0), color=curves.COLOURS[0])
                axes.tick_params(labelsize=7)
            row[0].set_ylabel(curves.label(cell.method.name), fontsize=8)
        for axes, column in zip(panels[-1], chosen, strict=True):
            axes.set_xlabel(names[column], fontsize=8)
        return drawn

    return draw
