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
from cmedirl_jax.runs.report.reward_samples import Learners, RewardedRun

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


def importances(run: RewardedRun) -> pl.DataFrame:
    """How much each reward depends on each input, on what its demonstrations and policy visit."""
    names, parts = inputs(run.context.env), []
    for learners in run.learners:
        measure = jax.jit(
            lambda params, steps, pay=learners.rewards.reward: importance.permutation(
                run.context.key, Rewards(pay, params), steps
            )
        )
        found = np.asarray(measure(learners.rewards.params, learners.visited))
        parts.append(learners.table(dict(zip(names, found.T, strict=True))))
    return pl.concat(parts)


def of_learners(learners: Learners, column: int) -> Slice:
    """A slice of their rewards along one input."""
    shown, size = learners.demonstrated, learners.demonstrated.observation.shape[-1]
    steps = np.concatenate([shown.observation, shown.action], axis=-1)
    low, high = np.percentile(steps[..., column], [1.0, 99.0])
    at = np.linspace(low, high, POINTS, dtype=np.float32)
    steps = np.repeat(steps[:, :STEPS, None], POINTS, axis=2)
    steps[..., column] = at
    pay = jax.jit(jax.vmap(learners.rewards.reward))
    paid = pay(learners.rewards.params, steps[..., :size], steps[..., size:])
    return Slice(at, np.asarray(jnp.mean(paid, axis=1)))


def figure(run: RewardedRun, importances: pl.DataFrame) -> Callable[[], Figure]:
    """Draws a row for each method and a column for each of the most important inputs."""
    names = inputs(run.context.env)
    chosen = sorted(np.argsort(importances.select(names).mean().row(0))[::-1][:MOST].tolist())
    slices = [[of_learners(each, column) for column in chosen] for each in run.learners]

    def draw() -> Figure:
        size = (2.3 * len(chosen) + 1.0, 1.9 * len(slices))
        drawn = Figure(figsize=size, layout="constrained")
        panels = drawn.subplots(len(slices), len(chosen), sharex="col", sharey="row", squeeze=False)
        for row, learners, of_method in zip(panels, run.learners, slices, strict=True):
            for axes, one in zip(row, of_method, strict=True):
                low, high = np.percentile(one.reward, [5.0, 95.0], axis=0)
                axes.fill_between(one.at, low, high, color=curves.COLOURS[0], alpha=0.2, lw=0)
                axes.plot(one.at, one.reward.mean(axis=0), color=curves.COLOURS[0])
                axes.tick_params(labelsize=7)
                axes.ticklabel_format(axis="y", useOffset=False)
            if not any(np.ptp(one.reward) for one in of_method):
                # The axis of a constant would show its rounding.
                row[0].set_ylim(of_method[0].reward.flat[0] + np.array([-1.0, 1.0]))
            row[0].set_ylabel(learners.name, fontsize=8)
        for axes, column in zip(panels[-1], chosen, strict=True):
            axes.set_xlabel(names[column], fontsize=8)
        return drawn

    return draw
