"""Evaluations by hand, and what loggers wrote of them."""

import csv

import numpy as np

from cmedirl_jax.runs.cells.record import EvaluationRows, Means
from cmedirl_jax.training.evaluation import Evaluation


def evaluation(step, returns, *, seeds=None, steps=None, protocol="steps", q_mean=np.nan):
    """An evaluation with these returns; its means are unknown but for Q."""
    count = len(returns)
    seeds = np.arange(count) if seeds is None else np.array(seeds)
    steps = np.full(count, step) if steps is None else np.array(steps)
    same = np.full(count, 0.5, np.float32)
    unknown = np.full(count, np.nan)
    means = Means(*(unknown for _ in Means._fields))._replace(q_mean=np.full(count, q_mean))
    statistics = Evaluation(np.array(returns, np.float32), same, same, same)
    return EvaluationRows(protocol, seeds, steps, steps // 10, statistics, means)


def table(path):
    """The rows of a CSV file, as texts by the names of their columns."""
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def scalars(folder):
    """Steps and values by tag, as TensorBoard reads them from a folder of event files."""
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    events = EventAccumulator(str(folder))
    events.Reload()
    return {
        tag: [(event.step, event.value) for event in events.Scalars(tag)]
        for tag in events.Tags()["scalars"]
    }
