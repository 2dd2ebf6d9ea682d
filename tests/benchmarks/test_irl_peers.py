"""The comparison with other libraries of IRL: its gridworlds, our loops, its numbers."""

import json
from pathlib import Path

import jax
import numpy as np
import pytest

from benchmarks import gail_ours, gridworlds, irl_ours, irl_peers, peers
from cmedirl_jax.data import demonstrations
from tests.support import mdps, pools, trainers

SIDE, HORIZON = 3, 6


@pytest.fixture
def problem(request, tmp_path):
    made = gridworlds.make(SIDE, HORIZON, ends=request.param)
    np.savez(tmp_path / "problem.npz", **made._asdict())
    return made, tmp_path / "problem.npz"


@pytest.mark.parametrize("problem", [False, True], indirect=True)
def test_demonstrations_are_made_of_possible_moves(problem):
    made, _ = problem
    np.testing.assert_allclose(made.transition.sum(axis=-1), 1.0)
    following = np.append(made.state[:, 1:], made.last[:, None], axis=1)
    full = made.mask.all(axis=1)
    assert (made.transition[made.state, made.action, following][full] > 0).all()
    assert full.all() == (not made.ends)
    assert (made.last[~full] == SIDE * SIDE - 1).all()


@pytest.mark.parametrize("problem", [False], indirect=True)
@pytest.mark.parametrize("form", irl_peers.FORMS)
def test_our_loop_takes_gradient_steps_of_a_float64_reference(problem, form):
    made, path = problem
    states = SIDE * SIDE
    initial = np.bincount(made.state[:, 0], minlength=states) / len(made.state)
    shown = np.bincount(made.state.ravel(), minlength=states) / len(made.state)

    def visits(table):
        _, policy = mdps.soft_backups(
            made.transition, np.repeat(table[:, None], 4, axis=1), 1.0, HORIZON
        )
        there, total = initial, np.zeros(states)
        for chances in policy:
            total += there
            there = np.einsum("s,sa,sat->t", there, chances, made.transition)
        return total, policy

    table = np.zeros(states)
    for _ in range(3):
        table += made.rate * (shown - visits(table)[0])
    with jax.enable_x64(True):
        result = jax.device_get(irl_ours.program(path, form)(3))
    expected, policy = visits(table)
    np.testing.assert_allclose(result.params, table, atol=1e-12)
    np.testing.assert_allclose(result.visitation.sum(axis=1), expected, atol=1e-12)
    np.testing.assert_allclose(np.exp(result.policy.log_probabilities), policy, atol=1e-12)


@pytest.mark.parametrize("problem", [True], indirect=True)
def test_where_episodes_end_lists_of_successors_change_nothing(problem):
    _, path = problem
    with jax.enable_x64(True):
        dense, lists = (jax.device_get(irl_ours.program(path, form)(2)) for form in irl_peers.FORMS)
    np.testing.assert_allclose(lists.visitation, dense.visitation, atol=1e-12)
    assert dense.visitation[-1].sum() == 0.0


def test_our_gail_answers_with_a_return_for_each_seed(tmp_path, monkeypatch):
    demonstrations.save(tmp_path / "pool.npz", pools.scripted(2))
    small = {"architecture": {"hidden": (4,)}, "reward_network": {"hidden": (4,)}}
    monkeypatch.setattr(gail_ours, "ALIKE", trainers.with_(gail_ours.ALIKE, **small))
    advances = []
    monkeypatch.setattr(gail_ours, "serve_from_command_line", advances.append)
    monkeypatch.setattr("sys.argv", ["gail_ours", str(tmp_path / "pool.npz"), "2", "8"])
    gail_ours.main()
    assert len(advances[0](8)["returns"]) == 2


class FakeWorker:
    """Answers as a loop does that takes a second for 10 steps."""

    def __init__(self, command, cores):
        self.peer = command[0] == "peer"
        self.stopped = False
        shift = 0.5 * self.peer
        self.facts = {"visitation": [1.0 + shift, 2.0], "log_likelihood": -3.0 - shift}
        if self.peer and command[2].endswith("imitation_mce"):
            self.facts["as_it_is"] = {"visitation": [0.0, 2.0], "log_likelihood": -3.0}
        self.seeds = 1 if self.peer or "gail" not in command[2] else int(command[4])

    def wait(self):
        pass

    def seconds(self, steps):
        return steps / 10 * (1 + self.peer)

    def ask(self, steps):
        return {"seconds": self.seconds(steps), "returns": [2.0] * self.seeds}

    def stop(self):
        self.stopped = True


def test_what_is_learned_and_how_fast_is_compared_and_a_missing_peer_is_named(
    tmp_path, monkeypatch, capsys
):
    workers = []

    def make(*arguments):
        workers.append(FakeWorker(*arguments))
        return workers[-1]

    def environment(name, requirements, folder):
        if name == "irl_maxent":
            raise RuntimeError("there is no such version")
        return Path("peer")

    monkeypatch.setattr(irl_peers, "Worker", make)
    monkeypatch.setattr(peers, "environment", environment)
    monkeypatch.setattr(peers, "versions", lambda python: {"numpy": "2"})
    monkeypatch.setattr(irl_peers, "demonstrations", lambda count: pools.scripted(2))
    path = tmp_path / "irl.json"
    options = irl_peers.Options(sides=(2,), gail_seeds=3, gail_steps=(20,), json=path)
    assert irl_peers.main(options) == 0
    result = json.loads(path.read_text())
    imitation, missing = result["with_model"]
    assert missing["error"] == "there is no such version"
    assert imitation["versions"] == {"numpy": "2"}
    assert imitation["difference_sparse"] == {"visitation": 0.5, "log_likelihood": 0.5}
    assert imitation["difference_as_it_is"] == {"visitation": 1.0, "log_likelihood": 0.0}
    assert imitation["dense_ratio"]["median"] == pytest.approx(2.0)
    assert imitation["peer_steps_per_second"] == pytest.approx(5.0)
    (gail,) = result["gail"]
    assert gail["ours"] == {"returns": [2.0] * 3, "env_steps_per_second": pytest.approx(30.0)}
    assert gail["ours_one_seed"]["env_steps_per_second"] == pytest.approx(10.0)
    assert gail["peer"] == {"returns": [2.0] * 3, "env_steps_per_second": pytest.approx(5.0)}
    assert all(worker.stopped for worker in workers)
    printed = capsys.readouterr().out
    assert "there is no such version" in printed
    assert "GAIL, 20 steps: ours 2.0" in printed


@pytest.mark.parametrize("module", ["imitation_mce", "irl_maxent_causal", "imitation_gail"])
def test_every_peer_has_its_loop(module):
    path = Path(peers.__file__).with_name("peer_loops") / f"{module}.py"
    assert "serve_from_command_line(" in path.read_text()
