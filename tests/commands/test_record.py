"""Demonstrations of a run or of a function, recorded on the command line."""

import functools

import numpy as np
import pytest

from cmedirl_jax.commands import demonstrators
from cmedirl_jax.commands.cmedirl import main
from cmedirl_jax.data import demonstrations
from cmedirl_jax.runs import load_policy
from cmedirl_jax.runs.cells import scale
from cmedirl_jax.runs.errors import UserError
from tests.support import pools

CAR = ["--env", pools.ENV.spec.id]


@pytest.fixture(autouse=True, scope="module")
def random_actions_once():
    """What random actions return on the car takes a second to measure."""
    measure = scale.random_return
    known = functools.cache(lambda starts: measure(pools.ENV, starts))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(scale, "random_return", lambda env, starts: known(starts))
        yield


def push(observation):
    return pools.controller(observation)


def test_record_plays_a_function_from_seeded_starts(tmp_path, capsys):
    out = tmp_path / "pool.npz"
    policy = f"{__name__}:push"
    command = ["demos", "record", str(out), *CAR, "--policy", policy, "--episodes", "2"]
    assert main([*command, "--reset-seed", "5"]) == 0
    assert "2 episodes, returns 97." in capsys.readouterr().out
    pool = demonstrations.load(out, pools.ENV.spec)
    demonstrations.check(pool, pools.ENV)
    assert pool.metadata["seeds"] == [5, 6]
    assert pool.metadata["source"] == policy
    # On Gymnasium's own car the same function does the same.
    command[command.index(CAR[1])] = f"gymnasium:{CAR[1]}"
    assert main(command) == 0
    assert demonstrations.load(out).metadata["env"] == f"gymnasium:{CAR[1]}"


def test_record_plays_what_a_run_has_learned(untrained_run, tmp_path):
    out = tmp_path / "pool.csv"
    of_run = ["--run", str(untrained_run), "--method", "ddpg", "--seed", "1", "--episodes", "1"]
    assert main(["demos", "record", str(out), *of_run]) == 0
    pool = demonstrations.read(out, env=pools.ENV)
    assert len(pool.episode) == 999
    assert pool.truncated[-1]


@pytest.mark.parametrize(
    ("quality", "learners"), [("expert", [2]), ("medium", [3]), ("mixed", [0, 1, 2, 3])]
)
def test_a_quality_chooses_learners_by_what_they_return(quality, learners):
    returns = np.array([-20.0, 90.0, 94.0, 40.0, np.nan])
    assert demonstrators.chosen_of(returns, -33.0, 94.0, quality) == learners


def test_no_learner_is_chosen_where_no_return_is_known():
    with pytest.raises(UserError, match="no learner's return is known"):
        demonstrators.chosen_of(np.array([np.nan]), -33.0, 94.0, "mixed")


def test_a_dataset_says_who_acted_and_has_reference_scores(untrained_run, tmp_path, monkeypatch):
    minari = pytest.importorskip("minari")
    monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
    of_run = ["--run", str(untrained_run), "--method", "ddpg", "--quality", "mixed"]
    facts = ["--author", "a", "--author-email", "b", "--code-permalink", "c"]
    for count, learners in ((1, 1), (2, 2)):
        name = f"test/car{count}/mixed-v0"
        options = [*of_run, *facts, "--episodes", str(count), "--ref-max-score", "94"]
        assert main(["demos", "record", name, *options]) == 0
        known = minari.load_dataset(name).storage.metadata
        assert known["algorithm_name"] == "ddpg"
        assert known["ref_min_score"] == pytest.approx(-33.1, abs=0.5)
        assert known["ref_max_score"] == 94.0
        for line in (
            f"{count} episodes, {999 * count} steps",
            f"ddpg, mixed: {learners} learners in turn of the 2",
            "this dataset scores",
        ):
            assert line in known["description"]
        assert str(untrained_run.parent) not in known["description"]
    # Learner i plays episode i, from the reset seed i.
    pool = demonstrations.read(name, env=pools.ENV)
    for seed in (0, 1):
        first = np.asarray(pool.episode) == seed
        act = load_policy(untrained_run, "ddpg", seed)
        seen, done = (np.asarray(x)[first] for x in pool.transition[:2])
        np.testing.assert_allclose(act(seen), done, atol=1e-5)


def test_an_expert_no_better_than_random_actions_is_refused(untrained_run, tmp_path, capsys):
    of_run = ["--run", str(untrained_run), "--method", "ddpg", "--quality", "expert"]
    command = ["demos", "record", str(tmp_path / "a.npz"), *of_run, "--ref-max-score", "-50"]
    assert main(command) == 2
    assert "--quality: the expert returns -50 and random actions -33" in capsys.readouterr().err
