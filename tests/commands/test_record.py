"""Demonstrations of a run or of a function, recorded on the command line."""

from cmedirl_jax.commands.cmedirl import main
from cmedirl_jax.data import demonstrations
from tests.support import pools

CAR = ["--env", pools.ENV.spec.id]


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
