"""Which of a pool's demonstrations each learner may draw from, and whose they are."""

from typing import Any, NamedTuple

import jax
import numpy as np

from cmedirl_jax.agents import hot_start
from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.types import DemonstrationSubset

EACH = "each"
"""In a pool's metadata: every learner has an expert of its own."""


class LearnersPool(NamedTuple):
    """A pool as the learners of a study use it; learner i has row i of every array.

    Attributes:
        data: the pool, with `episodes` `[learners, E]`: those that each learner draws from.
        expert: `[learners]` int, who demonstrates; -1 where that is not one expert, or not known.
        expert_return: `[learners]`, mean return of who demonstrates from the fixed evaluation
            starts; NaN where it is not known.
        expert_steps: `[learners]` int, environment steps that its demonstrators were trained for.
        metadata: of the pool.
    """

    data: HotStartData
    expert: np.ndarray
    expert_return: np.ndarray
    expert_steps: np.ndarray
    metadata: dict[str, Any]


def of_learners(
    pool: Demonstrations, learners: int, discount: float = 0.99, reward_scale: float = 1.0
) -> LearnersPool:
    """Share a pool among learners.

    With an expert each, learner i has expert i. If that one failed, it has the next that solved the
    task; where there are more learners than experts, they begin again with the first. Otherwise all
    learners draw from the whole pool.

    Args:
        pool: valid; its metadata are what `experts.make_pool` writes, or a user's.
        learners: how many there are.
        discount: see `hot_start.data`.
        reward_scale: likewise.

    Raises:
        ValueError: if the metadata of a pool with an expert for each learner does not fit the pool.
    """
    experts, returns = _experts(pool)
    data = hot_start.data(pool, discount, reward_scale)
    metadata, episodes = pool.metadata, data.episodes
    steps = metadata.get("expert_env_steps", 0)
    if metadata.get("expert") == EACH:
        numbers = np.arange(learners) % metadata["experts_trained"]
        who = np.searchsorted(experts, numbers) % len(experts)
        blocks = [leaf.reshape(len(experts), -1)[who] for leaf in episodes]
        expert, expert_return = np.asarray(experts)[who], returns[who]
        # What it takes to get one expert that solves the task.
        steps //= len(experts)
    else:
        blocks = [np.broadcast_to(leaf, (learners, leaf.size)) for leaf in episodes]
        one = experts[0] if len(experts) == 1 else -1
        expert = np.full(learners, one)
        expert_return = np.full(learners, returns.mean() if returns.size else np.nan)
    return LearnersPool(
        data._replace(episodes=DemonstrationSubset(*blocks)),
        expert,
        expert_return,
        np.full(learners, steps),
        metadata,
    )


def held(pool: Demonstrations) -> int:
    """How many of the pool's episodes a learner draws from.

    Raises:
        ValueError: as `of_learners`.
    """
    experts, _ = _experts(pool)
    sharing = len(experts) if pool.metadata.get("expert") == EACH else 1
    return _size(pool) // sharing


def _experts(pool: Demonstrations) -> tuple[list[int], np.ndarray]:
    """Who demonstrates, as far as the metadata say so, and what each of them returns."""
    metadata = pool.metadata
    experts = _integers(metadata, "experts_demonstrating")
    returns = np.asarray(metadata.get("expert_returns", [np.nan] * len(experts)), float)
    if metadata.get("expert") != EACH:
        return experts, returns
    trained = metadata.get("experts_trained", 0)
    if (
        not experts
        or _size(pool) % len(experts)
        or returns.size != len(experts)
        or type(trained) is not int
        or trained <= experts[-1]
    ):
        raise ValueError("its metadata do not say whose its episodes are")
    return experts, returns


def _size(pool: Demonstrations) -> int:
    return int(pool.episode[-1]) + 1


def episodes_of(data: HotStartData, learners: np.ndarray) -> DemonstrationSubset:
    """The episodes `[n, E]` that these learners `[n]` draw from; the last one's beyond the study's.

    Args:
        data: with `episodes` `[learners, E]`, as `of_learners` gives them.
        learners: their numbers.
    """
    last = len(data.episodes.start) - 1
    return jax.tree.map(lambda leaf: leaf[np.minimum(learners, last)], data.episodes)


def _integers(metadata: dict[str, Any], name: str) -> list[int]:
    values = metadata.get(name, [])
    if not isinstance(values, list) or any(type(value) is not int for value in values):
        raise ValueError(f"{name} in its metadata is {values!r}, no list of whole numbers")
    return sorted(values)
