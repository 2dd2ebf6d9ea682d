import jax
import numpy as np
import pytest

from cmedirl_jax.data.episodes import EpisodesState
from cmedirl_jax.irl import reward_batches
from cmedirl_jax.irl.reward_batches import RewardBatchSettings
from cmedirl_jax.irl.sample_weights import MixtureState, RecordedState
from tests.support.samples import (
    ACTOR,
    BEHAVIOURS,
    CAPACITY,
    KEY,
    NETWORKS,
    PERIOD,
    POOL,
    REPLAY,
    SPEC,
    SUBSET,
    actor_at,
    made,
)


def test_nothing_is_kept_that_nothing_needs():
    needs = {
        ("uniform", "visitation"): (None, None),
        ("recorded", "transition"): (None, RecordedState),
        ("fusion", "visitation"): (None, MixtureState),
        ("uniform", "trajectory"): (EpisodesState, None),
    }
    for (weights, objective), kept in needs.items():
        state = jax.eval_shape(made(weights, objective).init, KEY, ACTOR, POOL, SUBSET)
        types = [None if part is None else type(part) for part in (state.source, state.weights)]
        assert tuple(types) == kept


def test_seeds_in_step_keep_their_own():
    record = jax.vmap(made("fusion", "trajectory").record, in_axes=(0, 0, None, 0, 0))
    actors = jax.tree.map(lambda *leaves: np.stack(leaves), actor_at(0), actor_at(1))
    state = made("fusion", "trajectory").init(KEY, ACTOR, POOL, SUBSET)
    states = jax.tree.map(lambda leaf: np.stack([leaf] * 2), state)
    inputs = actors, np.int32(PERIOD), np.zeros(2, np.float32), np.array([True, False])
    states = jax.device_get(jax.jit(record)(states, *inputs))
    snapshots = jax.tree.leaves(states.weights.snapshots)
    for leaf, actor in zip(snapshots, jax.tree.leaves(actors), strict=True):
        np.testing.assert_array_equal(leaf[:, 1], actor)
        assert not leaf[:, [0, 2]].any()
    np.testing.assert_array_equal(states.source.count, [1, 0])
    np.testing.assert_array_equal(states.source.length[:, 0], [PERIOD + 1, 0])


@pytest.mark.parametrize("name", ["snapshots", "snapshot_period", "episodes"])
def test_numbers_must_be_positive(name):
    settings = RewardBatchSettings(weights="fusion", **{name: 0})
    parts = SPEC, NETWORKS, BEHAVIOURS["epsilon-greedy"], REPLAY, CAPACITY
    with pytest.raises(ValueError, match=f"^{name} must be at least 1, got 0"):
        reward_batches.make(*parts, settings, objective="trajectory", append=True)
