"""A run's rewards, and the steps of demonstrations and policies by which they are judged."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

from cmedirl_jax import envs
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells import pools, recording
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import LearnedCell, learned_cells
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import folder as run_folder
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

    @property
    def visited(self) -> Transition:
        """The steps of demonstrations that were seen and of the policies together, `[seeds, N]`."""
        return jax.tree.map(lambda *leaves: np.concatenate(leaves, axis=1), *self.seen)


class Judged(NamedTuple):
    """A run's rewards.

    Attributes:
        context: what they share.
        cells: the finished cells that learned one, with the steps of each.
    """

    context: Context
    cells: list[tuple[LearnedCell, Sampled]]


def read(folder: Path) -> Judged:
    """The rewards of a run, and steps to judge them by.

    Raises:
        UserError: if the folder holds no run, or one without demonstrations or rewards.
    """
    config: dict[str, Any] = run_folder.read(folder)["config"]
    pool = stored_demonstrations.load(folder)
    if pool is None:
        raise UserError(f"{folder}: the run has no demonstrations to assess a reward by")
    try:
        env, learned = envs.find(config["env"]), learned_cells(folder)
        # Cells of older versions are found out here.
        for cell in learned:
            cell.policies()
    except (LookupError, ValueError) as error:
        raise UserError(f"{folder}: {' '.join(str(error).split())}") from error
    rewarded = [cell for cell in learned if cell.has_rewards]
    if not rewarded:
        raise UserError(f"{folder}: none of its methods learns a reward")
    discount = config["settings"]["agent"]["discount"]
    learners = max(cell.cell.key.seed_range.stop for cell in rewarded)
    context = Context(env, pool, discount, learners, jax.random.key(config["seed"]))
    return Judged(context, [(cell, of_cell(context, cell)) for cell in rewarded])


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
