"""Gridworlds with demonstrations, as arrays that any library can read."""

import itertools
from typing import NamedTuple

import numpy as np

MOVES = ((0, 1), (1, 0), (0, -1), (-1, 0))
SLIP = 0.1
"""Chance that a move goes another way, each of the four alike."""
DEMONSTRATIONS = 100


class Problem(NamedTuple):
    """What a reward of states is learned from, by gradient steps of one size.

    Attributes:
        transition: `[S, A, S]`, P(s'|s, a).
        state: `[N, T]` int, demonstrated.
        action: `[N, T]` int.
        mask: `[N, T]` bool, False past a demonstration's end.
        last: `[N]` int, the state after the last action.
        rate: of the gradient ascent.
        first: what every state is worth before it.
        ends: whether the last cell ends an episode; else an episode has T steps.
    """

    transition: np.ndarray
    state: np.ndarray
    action: np.ndarray
    mask: np.ndarray
    last: np.ndarray
    rate: np.ndarray
    first: np.ndarray
    ends: np.ndarray


def make(side: int, horizon: int, *, ends: bool) -> Problem:
    """A gridworld of `side` x `side` cells, whose demonstrations go to its last cell.

    Args:
        side: cells along each side.
        horizon: steps of a demonstration, at most.
        ends: whether an episode ends in the last cell.
    """
    transition = dynamics(side)
    states, rng = side * side, np.random.default_rng(side)
    state, action = np.zeros((2, DEMONSTRATIONS, horizon), np.int64)
    mask = np.zeros(state.shape, bool)
    last = np.zeros(DEMONSTRATIONS, np.int64)
    for n in range(DEMONSTRATIONS):
        at = rng.integers(states - 1)
        for t in range(horizon):
            if ends and at == states - 1:
                break
            # Right or down where there is such a way; else, and one time in five, any way.
            ways = [i for i in range(2) if transition[at, i, at] < 0.5]
            move = rng.choice(ways) if ways and rng.random() < 0.8 else rng.integers(4)
            state[n, t], action[n, t], mask[n, t] = at, move, True
            at = rng.choice(states, p=transition[at, move])
        last[n] = at
    # Where episodes end by themselves, the sum over all of them has to be finite: log 4 < 3.
    first = -3.0 if ends else 0.0
    return Problem(transition, state, action, mask, last, *map(np.asarray, (0.05, first, ends)))


def dynamics(side: int, slip: float = SLIP) -> np.ndarray:
    """`[S, A, S]`: four moves, which end at the walls and go another way by the chance `slip`."""
    chances = np.zeros((side * side, 4, side * side))
    for (row, column), action in itertools.product(np.ndindex(side, side), range(4)):
        for index, (down, right) in enumerate(MOVES):
            to = np.clip((row + down, column + right), 0, side - 1)
            share = slip / 4 + (1.0 - slip) * (index == action)
            chances[row * side + column, action, to[0] * side + to[1]] += share
    return chances
