"""Minari's datasets: what they keep, and what they cannot hold."""

import json

import gymnasium
import numpy as np
import pytest

from cmedirl_jax.data import demonstrations
from tests.support import ROOT, pools
from tests.support.formats import FACTS, SPEC, as_pool, episodes


def test_a_dataset_of_minaris_keeps_its_seeds_and_metadata(tmp_path):
    minari = pytest.importorskip("minari")
    pool = as_pool(episodes())
    pool = pool._replace(metadata=pool.metadata | {"seeds": [5, 6, 7]})
    demonstrations.to_minari(pool, "test/kept-v3", spec=SPEC, **FACTS)
    # Minari alone reads it.
    dataset = minari.load_dataset("test/kept-v3")
    assert (dataset.total_episodes, dataset.total_steps) == (3, 8)
    assert dataset.env_spec.id == SPEC.id
    again = demonstrations.from_minari("test/kept-v3")
    assert again.metadata["seeds"] == [5, 6, 7]
    assert again.metadata["author"] in ("somebody", ["somebody"])
    assert again.metadata["ref_max_score"] == 90.0
    assert json.dumps(again.metadata)
    with pytest.raises(ValueError, match="already exist"):
        demonstrations.to_minari(pool, "test/kept-v3", spec=SPEC, **FACTS)
    with pytest.raises(ValueError, match="Minari's ids are"):
        demonstrations.to_minari(pool, "no version", spec=SPEC)
    with pytest.raises(FileNotFoundError, match=r"fetch it by: minari download test/absent-v0"):
        demonstrations.read("test/absent-v0")


def test_a_pool_gives_what_it_knows_of_itself_to_the_next_dataset():
    minari = pytest.importorskip("minari")
    facts = {name: value for name, value in FACTS.items() if name != "eval_env"}
    demonstrations.to_minari(as_pool(episodes()), "test/first-v0", spec=SPEC, **facts)
    again = demonstrations.from_minari("test/first-v0")
    # A fact that was lost would be warned of, and warnings are errors here.
    demonstrations.to_minari(again, "test/second-v0", spec=SPEC)
    first, second = (
        minari.load_dataset(f"test/{name}-v0").storage.metadata for name in ("first", "second")
    )
    assert {**first, "dataset_id": None} == {**second, "dataset_id": None}


def test_the_cars_dataset_is_minaris_and_the_tasks_own(monkeypatch):
    """It was made by `python -m experiments.datasets`."""
    minari = pytest.importorskip("minari")
    folder = ROOT / "tests" / "support" / "minari"
    assert sum(path.stat().st_size for path in folder.rglob("*")) < 5e6
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(folder))
    # By Minari alone: its environment plays the first episode again.
    dataset = minari.load_dataset("classic-control/mountaincarcontinuous/expert-v0")
    assert dataset.total_episodes == 100
    env, episode = dataset.recover_environment(), dataset[0]
    observation, _ = env.reset(seed=0)
    for action, seen, paid in zip(
        episode.actions, episode.observations, episode.rewards, strict=False
    ):
        np.testing.assert_allclose(observation, seen, atol=1e-5)
        observation, reward, *_ = env.step(action)
        assert reward == pytest.approx(paid, abs=1e-4)
    assert minari.get_normalized_score(dataset, np.array([97.0]))[0] > 0.98
    # By us: every step is the task's own.
    pool = demonstrations.read(dataset.spec.dataset_id, env=pools.ENV)
    demonstrations.check(pool, pools.ENV)
    assert demonstrations.returns(pool).mean() == pytest.approx(93.06, abs=0.01)
    assert pool.metadata["seeds"] == list(range(100))


def test_a_minari_dataset_of_an_environment_that_is_not_here(tmp_path):
    minari = pytest.importorskip("minari")
    from minari.data_collector.episode_buffer import EpisodeBuffer

    box = gymnasium.spaces.Box
    trajectory = episodes([3])[0]
    buffer = EpisodeBuffer(
        id=0,
        observations=trajectory["observations"],
        actions=trajectory["actions"],
        rewards=list(trajectory["rewards"]),
        terminations=[False, False, True],
        truncations=[False] * 3,
    )
    facts = {name: value for name, value in FACTS.items() if name != "eval_env"}
    with pytest.warns(UserWarning, match="env"):
        minari.create_dataset_from_buffers(
            "test/foreign-v0",
            [buffer],
            observation_space=box(-2, 2, (2,), np.float64),
            action_space=box(-1, 1, (1,), np.float64),
            **facts,
        )
    with pytest.raises(ValueError, match="it does not name its task: give env"):
        demonstrations.from_minari("test/foreign-v0")
    pool = demonstrations.read("test/foreign-v0", env=SPEC)
    assert pool.transition.terminated.tolist() == [False, False, True]


@pytest.mark.parametrize("name", ["action", "reward"])
def test_what_a_pool_lacks_is_not_made_up(name):
    trajectories = episodes()
    for each in trajectories:
        each[f"{name}s"] = None
    with pytest.raises(ValueError, match=f"Minari's datasets have {name}s, this pool has none"):
        demonstrations.to_minari(as_pool(trajectories), "test/lacking-v0", spec=SPEC)


def test_a_dataset_that_cannot_be_written_leaves_nothing(monkeypatch):
    pytest.importorskip("minari")
    from minari import storage

    facts = {**FACTS, "eval_env": "No-v0"}
    with pytest.raises(gymnasium.error.Error):
        demonstrations.to_minari(as_pool(episodes()), "test/broken-v0", spec=SPEC, **facts)
    assert not storage.get_dataset_path("test/broken-v0").exists()
    demonstrations.to_minari(as_pool(episodes()), "test/broken-v0", spec=SPEC, **FACTS)


def test_a_dataset_that_may_not_be_read_is_not_called_damaged(monkeypatch):
    minari = pytest.importorskip("minari")

    def refuse(*arguments, **options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(minari, "load_dataset", refuse)
    with pytest.raises(PermissionError, match="Permission denied"):
        demonstrations.from_minari("test/closed-v0")
