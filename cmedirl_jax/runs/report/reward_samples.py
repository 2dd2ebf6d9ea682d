"""A run's rewards, and the steps of demonstrations and policies by which they are judged."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
import polars as pl

from cmedirl_jax import envs
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells import pools, recording
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import LearnedCell, learned_cells
from cmedirl_jax.runs.report.summary import cell_label
from cmedirl_jax.runs.storage import demonstrations as stored_demonstrations
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import DemonstrationSubset, Transition

LEARNER = ("method", "n_demos", "seed")
"""The columns that say whose a row is."""
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


class Learners(NamedTuple):
    """The learners of one method and one number of demonstrations, `R` of them.

    Attributes:
        method: theirs.
        n_demos: demonstrations of each.
        settings: theirs.
        seeds: `[R]`, their numbers.
        rewards: what they have learned.
        demonstrated: steps of demonstrations that each may have drawn, leaves `[R, SAMPLED, ...]`.
        played: steps of each one's best policy, likewise.
        held_out: steps of other demonstrations, likewise; None where there are none.
    """

    method: Method
    n_demos: int
    settings: Settings
    seeds: np.ndarray
    rewards: Rewards
    demonstrated: Transition
    played: Transition
    held_out: Transition | None

    @property
    def name(self) -> str:
        """What they are called in tables and figures."""
        return cell_label(self.method.name, self.n_demos)

    @property
    def visited(self) -> Transition:
        """The steps of `demonstrated` and `played` together, leaves `[R, 2 SAMPLED, ...]`."""
        return jax.tree.map(
            lambda *leaves: np.concatenate(leaves, axis=1), self.demonstrated, self.played
        )

    def table(self, columns: Mapping[str, Any]) -> pl.DataFrame:
        """A row for each learner: method, n_demos, seed, and columns `[R]`."""
        return pl.DataFrame(
            {
                "method": [self.method.name] * len(self.seeds),
                "n_demos": [self.n_demos] * len(self.seeds),
                "seed": self.seeds.astype(np.int64),
                **{name: np.asarray(column, np.float64) for name, column in columns.items()},
            }
        )


def with_experts(rows: pl.DataFrame, seeds: pl.DataFrame) -> pl.DataFrame:
    """Rows of learners with their `expert_id`, null where there is none.

    Args:
        rows: with the columns `LEARNER`.
        seeds: the run's table.
    """
    return rows.join(seeds.select(*LEARNER, "expert_id"), on=LEARNER, how="left")


class RewardedRun(NamedTuple):
    """A run's rewards.

    Attributes:
        context: what they share.
        learners: of each method that learned a reward, and each number of demonstrations.
        diverged: learners that are left out, because their rewards are not finite.
    """

    context: Context
    learners: list[Learners]
    diverged: int


def read(folder: Path) -> RewardedRun:
    """The rewards of a run, and steps to judge them by.

    Raises:
        UserError: if the folder holds no run, or one without demonstrations or finite rewards.
    """
    config: dict[str, Any] = run_folder.read(folder)["config"]
    pool = stored_demonstrations.load(folder)
    if pool is None:
        raise UserError(f"{folder}: the run has no demonstrations to assess a reward by")
    cells: dict[tuple[str, int], list[LearnedCell]] = {}
    try:
        env = envs.find(config["env"])
        for cell in learned_cells(folder):
            # Cells of older versions are found out here.
            cell.policies()
            if cell.has_rewards:
                cells.setdefault((cell.method.name, cell.cell.key.n_demos), []).append(cell)
    except (LookupError, ValueError) as error:
        raise UserError(f"{folder}: {' '.join(str(error).split())}") from error
    if not cells:
        raise UserError(f"{folder}: none of its methods learns a reward")
    discount = config["settings"]["agent"]["discount"]
    stops = [cell.cell.key.seed_range.stop for blocks in cells.values() for cell in blocks]
    context = Context(env, pool, discount, max(stops), jax.random.key(config["seed"]))
    blocks = [_joined([_of_cell(context, cell) for cell in group]) for group in cells.values()]
    found = [learners for learners in blocks if len(learners.seeds)]
    if not found:
        raise UserError(f"{folder}: all learners have diverged, and no reward is finite")
    there = sum(cell.cell.key.seeds for group in cells.values() for cell in group)
    return RewardedRun(context, found, there - sum(len(each.seeds) for each in found))


def _of_cell(context: Context, learned: LearnedCell) -> Learners:
    """The learners of one block of seeds whose rewards are finite."""
    rng, pool, key = np.random.default_rng(0), context.pool, learned.cell.key
    pay, params = learned.rewards()
    finite = [
        np.isfinite(leaf).reshape(key.seeds, -1).all(axis=1) for leaf in jax.tree.leaves(params)
    ]
    which = np.flatnonzero(np.logical_and.reduce(finite))
    seeds = key.first_seed + which
    # Steps of demonstrations, and of the policies.
    every = demonstrations.episodes(pool)
    of_learners = pools.of_learners(pool, context.seeds).data.episodes
    mine, others = [], []
    for seed in seeds:
        own = DemonstrationSubset(*(np.asarray(leaf)[seed] for leaf in of_learners))
        unseen = ~np.isin(every.start, own.start)
        mine.append((pool, own))
        others.append((pool, DemonstrationSubset(*(leaf[unseen] for leaf in every))))
    played = [(each, demonstrations.episodes(each)) for each in _played(context, learned, which)]
    held_out = _drawn(rng, others) if all(subset.start.size for _, subset in others) else None
    return Learners(
        method=learned.method,
        n_demos=key.n_demos,
        settings=learned.settings,
        seeds=seeds,
        rewards=Rewards(pay, _rows(params, which)),
        demonstrated=_drawn(rng, mine),
        played=_drawn(rng, played),
        held_out=held_out,
    )


def _rows(params: Any, which: np.ndarray) -> Any:
    return jax.tree.map(lambda leaf: np.asarray(leaf)[which], params)


def _joined(blocks: Sequence[Learners]) -> Learners:
    """Blocks of seeds of the same method as one."""

    def join(*trees: Any) -> Any:
        return jax.tree.map(lambda *leaves: np.concatenate(leaves), *trees)

    first = blocks[0]
    held_out = [block.held_out for block in blocks]
    return first._replace(
        seeds=np.concatenate([block.seeds for block in blocks]),
        rewards=first.rewards._replace(params=join(*(block.rewards.params for block in blocks))),
        demonstrated=join(*(block.demonstrated for block in blocks)),
        played=join(*(block.played for block in blocks)),
        held_out=None if None in held_out else join(*held_out),
    )


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


def _played(context: Context, learned: LearnedCell, which: np.ndarray) -> list[Demonstrations]:
    """Noise-free episodes of the best policies of some of a cell's learners."""
    act, actors = learned.policies()
    keys = jax.random.split(context.key, learned.cell.key.seeds)[which]
    return recording.record_each(act, context.env, _rows(actors, which), list(keys), EPISODES)
