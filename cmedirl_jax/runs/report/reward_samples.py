"""Steps of demonstrations and policies by which rewards are judged."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells import pools, recording
from cmedirl_jax.runs.load import LearnedCell
from cmedirl_jax.types import DemonstrationSubset, Transition

SAMPLED = 2_048
"""Steps of demonstrations, and of each policy."""
EPISODES = 4
"""Episodes of each policy, from random starts."""


class Context(NamedTuple):
    """What the cells of a run share."""

    env: Env | HostEnv
    pool: Demonstrations
    discount: float
    seeds: int
    key: jax.Array


class Sampled(NamedTuple):
    """Steps, leaves `[seeds, SAMPLED, ...]`: demonstrations beside what the policies do.

    Attributes:
        seen: of demonstrations that the learner may have drawn, and of its policy.
        held_out: of other demonstrations; None where there are none.
    """

    seen: tuple[Transition, Transition]
    held_out: Transition | None


def of_cell(context: Context, learned: LearnedCell) -> Sampled:
    """Steps of the demonstrations and the policies of a cell."""
    rng, pool = np.random.default_rng(0), context.pool
    every = demonstrations.episodes(pool)
    learners = pools.of_learners(pool, context.seeds).data.episodes
    mine, others = [], []
    for seed in learned.cell.key.seed_range:
        own = DemonstrationSubset(*(np.asarray(leaf)[seed] for leaf in learners))
        unseen = ~np.isin(every.start, own.start)
        mine.append((pool, own))
        others.append((pool, DemonstrationSubset(*(leaf[unseen] for leaf in every))))
    played = [(each, demonstrations.episodes(each)) for each in _played(context, learned)]
    held_out = _drawn(rng, others) if all(subset.start.size for _, subset in others) else None
    return Sampled((_drawn(rng, mine), _drawn(rng, played)), held_out)


def _drawn(
    rng: np.random.Generator, of_seeds: Sequence[tuple[Demonstrations, DemonstrationSubset]]
) -> Transition:
    """Steps of each seed's episodes, each step alike, leaves `[seeds, SAMPLED, ...]`."""
    parts = []
    for pool, (start, length) in of_seeds:
        ends = np.cumsum(length)
        index = rng.integers(ends[-1], size=SAMPLED)
        episode = np.searchsorted(ends, index, side="right")
        rows = start[episode] + index - (ends - length)[episode]
        parts.append([np.asarray(leaf)[rows] for leaf in pool.transition])
    return Transition(*(np.stack(leaves) for leaves in zip(*parts, strict=True)))


def _played(context: Context, learned: LearnedCell) -> list[Demonstrations]:
    """Noise-free episodes of each seed's best policy."""
    act, actors = learned.policies()
    keys = jax.random.split(context.key, learned.cell.key.seeds)
    return recording.record_each(act, context.env, actors, list(keys), EPISODES)
