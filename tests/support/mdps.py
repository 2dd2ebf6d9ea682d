"""Small finite Markov decision processes, and slow float64 references for them."""

import numpy as np

from benchmarks import gridworlds
from cmedirl_jax.tabular import SparseDynamics


def random_mdp(seed, states=4, actions=3, deterministic=False, absorbing=False):
    """`(dynamics [S, A, S], reward [S, A], initial [S], absorbing [S] or None)`, float64."""
    rng = np.random.default_rng(seed)
    if deterministic:
        dynamics = np.eye(states)[rng.integers(0, states, (states, actions))]
    else:
        dynamics = rng.dirichlet(np.full(states, 0.5), (states, actions))
    ends = None
    if absorbing:
        ends = np.arange(states) == states - 1
        # Every state leads there with probability 1/2 or more, so that episodes end soon.
        dynamics[:, 0] = 0.5 * dynamics[:, 0] + 0.5 * np.eye(states)[-1]
        if deterministic:
            dynamics[:, 0] = np.eye(states)[-1]
    return dynamics, rng.normal(size=(states, actions)), rng.dirichlet(np.ones(states)), ends


def sparse(dynamics):
    """The same dynamics with every state as a successor, listed twice and in another order."""
    states, actions, _ = dynamics.shape
    order = np.random.default_rng(0).permutation(np.repeat(np.arange(states), 2))
    next_state = np.broadcast_to(order, (states, actions, 2 * states)).astype(np.int32)
    return SparseDynamics(next_state, 0.5 * dynamics[..., order])


def gridworld(size=5, slip=0.0):
    """`(dynamics, absorbing)`: four moves on `size` x `size` cells, the last one absorbing."""
    states = size * size
    return gridworlds.dynamics(size, slip), np.arange(states) == states - 1


def soft_backups(dynamics, reward, discount, horizon, temperature=1.0, absorbing=None):
    """`(values [T, S], policy [T, S, A])` by the recursion, in numpy."""
    values, policies, after = [], [], np.zeros(len(reward))
    for _ in range(horizon):
        q = reward + discount * dynamics @ after
        weight = np.exp(q / temperature)
        after = temperature * np.log(weight.sum(axis=1))
        if absorbing is not None:
            after = np.where(absorbing, 0.0, after)
        values.append(after)
        policies.append(weight / weight.sum(axis=1, keepdims=True))
    return np.array(values[::-1]), np.array(policies[::-1])


def trajectories(dynamics, policy, initial, absorbing=None):
    """Every `(probability, [(state, action), ...])` of the policy `[T, S, A]`, one by one."""
    ends = np.zeros(len(initial), bool) if absorbing is None else absorbing

    def extend(time, state, probability, pairs):
        if time == len(policy) or ends[state]:
            yield probability, pairs
            return
        for action, chance in enumerate(policy[time, state]):
            for following, moved in enumerate(dynamics[state, action]):
                if moved > 0:
                    yield from extend(
                        time + 1, following, probability * chance * moved, [*pairs, (state, action)]
                    )

    for state, probability in enumerate(initial):
        yield from extend(0, state, probability, [])


def counted_visits(weighted, discount, shape):
    """sum of probability * gamma^t over the visits of each pair, `[S, A]`."""
    visits = np.zeros(shape)
    for probability, pairs in weighted:
        for time, pair in enumerate(pairs):
            visits[pair] += probability * discount**time
    return visits


def demonstrate(dynamics, starts, length, ends, seed):
    """One list of (state, action) per start, by a policy that is optimal for no reward."""
    rng = np.random.default_rng(seed)
    states, actions, _ = dynamics.shape
    demonstrations = []
    for state in starts:
        pairs = []
        while len(pairs) < length and not (ends is not None and ends[state]):
            action = rng.integers(actions)
            pairs.append((state, action))
            state = rng.choice(states, p=dynamics[state, action])
        demonstrations.append(pairs)
    return demonstrations


def padded(demonstrations, length):
    """`(state, action, mask)`, each `[N, length]`, with -1 past an end."""
    steps = np.full((2, len(demonstrations), length), -1)
    for row, pairs in enumerate(demonstrations):
        steps[:, row, : len(pairs)] = np.transpose(pairs)
    return *steps, steps[0] >= 0
