"""Steps of demonstrations and policies by which rewards are judged."""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import jax
import numpy as np

from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells import pools, recording
from cmedirl_jax.runs.load import LearnedCell
from cmedirl_jax.types import DemonstrationSubset, Transition

SAMPLED = 512
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
    key = learned.cell.key
    played = _played(context, learned)
    rng = np.random.default_rng(0)
    episodes = pools.of_learners(context.pool, context.seeds).data.episodes
    mine = [_rows(episodes, seed) for seed in key.seed_range]
    every = np.arange(len(context.pool.episode))
    others = [np.setdiff1d(every, rows) for rows in mine]

    def drawn(of_seeds: Sequence[tuple[Demonstrations, np.ndarray]]) -> Transition:
        parts = []
        for pool, rows in of_seeds:
            chosen = rng.choice(rows, SAMPLED)
            parts.append([np.asarray(leaf)[chosen] for leaf in pool.transition])
        return Transition(*(np.stack(leaves) for leaves in zip(*parts, strict=True)))

    seen = drawn([(context.pool, rows) for rows in mine])
    policies = drawn([(pool, np.arange(len(pool.episode))) for pool in played])
    unseen = all(len(rows) for rows in others)
    held_out = drawn([(context.pool, rows) for rows in others]) if unseen else None
    return Sampled((seen, policies), held_out)


def _played(context: Context, learned: LearnedCell) -> list[Demonstrations]:
    """Noise-free episodes of each seed's best policy."""
    env, (act, actors) = context.env, learned.policies()
    keys = jax.random.split(context.key, learned.cell.key.seeds)
    if isinstance(env, HostEnv):
        return recording.record_on_host(act, env, actors, list(keys), EPISODES)
    one = functools.partial(recording.record, act, env, episodes=EPISODES)
    transition, running, truncated = jax.device_get(jax.jit(jax.vmap(one))(actors, keys))
    return [
        recording.flatten(
            jax.tree.map(lambda leaf, seed=seed: leaf[seed], transition),
            running[seed],
            truncated[seed],
        )
        for seed in range(len(keys))
    ]


def _rows(episodes: DemonstrationSubset, learner: int) -> np.ndarray:
    """The steps of the episodes that a learner draws from."""
    start, length = (np.asarray(leaf)[learner] for leaf in episodes)
    return np.concatenate([np.arange(s, s + n) for s, n in zip(start, length, strict=True)])
