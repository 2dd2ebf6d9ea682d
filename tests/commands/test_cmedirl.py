"""The installed command: its help, its refusals, and what is missing."""

import subprocess
import sys

import pytest

from cmedirl_jax.commands import cmedirl, entry

COMMANDS = (
    *("demos inspect", "demos convert", "demos record", "demos template"),
    *("train", "evaluate", "watch", "reward"),
)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_explains_itself_with_an_example(command, capsys):
    with pytest.raises(SystemExit, match="0"):
        cmedirl.main([*command.split(), "--help"])
    output = " ".join(capsys.readouterr().out.split())
    assert f"Example: cmedirl {command} " in output


def test_the_help_names_every_command(capsys):
    with pytest.raises(SystemExit, match="0"):
        cmedirl.main(["--help"])
    output = capsys.readouterr().out
    for command in {name.split()[0] for name in COMMANDS}:
        assert command in output


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("demos inspect none.csv", "there is no file none.csv, nor a dataset of that name"),
        ("demos inspect x.csv --env No-v0", "--env: unknown environment 'No-v0'; there are: "),
        ("demos convert a.csv b.txt --env Pendulum-v1", "b.txt: it ends in none of .npz, .csv,"),
        ("demos record a.npz", "give either --run, or --policy and --env"),
        ("demos record a.npz --policy a:b", "--env: name the task that --policy acts in"),
        (
            "demos record a.npz --env Pendulum-v1 --policy a:b",
            "--policy: a:b is no MODULE:FUN",
        ),
        ("demos record a.npz --run nowhere", "nowhere: holds no run"),
        ("demos record a.npz --run x --env y", "--env: says nothing beside --run"),
        (
            "demos record a.npz --env Pendulum-v1 --policy a:b --seed 3",
            "--seed: says nothing beside --policy",
        ),
        (
            "demos record a.npz --run x --quality medium --seed 3",
            "--seed: says nothing beside --quality",
        ),
        (
            "demos record a.npz --run x --ref-max-score 3",
            "--ref-max-score: says nothing without --quality",
        ),
        ("demos convert a.csv b.csv --env broken:X-v0", "--env: broken:X-v0 cannot be made"),
        ("train --env broken:X-v0", "--env: broken:X-v0 cannot be made"),
        ("demos record a.npz --run x --episodes 0", "--episodes: must be at least 1, got 0"),
        ("demos template a.txt --env Pendulum-v1", "a.txt: give a name that ends in .csv or"),
        ("evaluate nowhere", "nowhere: holds no run"),
        ("reward nowhere", "nowhere: holds no run"),
        ("evaluate x --starts 0", "--starts: must be at least 1, got 0"),
        ("train --method ppo", "--methods: unknown method 'ppo'; there are ddpg, hs-ddpg,"),
        ("train --env No-v0", "--env: unknown environment 'No-v0'; there are: "),
        ("train --demos none.csv", "--demos: there is no file none.csv, nor a dataset"),
        ("train --agent.tau 7", "--agent.tau: must be above 0 and at most 1, got 7.0"),
    ],
)
def test_a_mistake_is_a_line_and_code_2(arguments, line, tmp_path, monkeypatch, capsys):
    work, modules = tmp_path / "work", tmp_path / "modules"
    for folder in (work, modules):
        folder.mkdir()
    (modules / "broken.py").write_text("raise RuntimeError('no such robot')")
    monkeypatch.syspath_prepend(modules)
    monkeypatch.chdir(work)
    assert cmedirl.main(arguments.split()) == 2
    error = capsys.readouterr().err
    assert error.startswith(f"cmedirl: {line}")
    assert error.count("\n") == 1
    assert list(work.iterdir()) == []


@pytest.mark.parametrize("command", ["train --env", "demos inspect a.csv --env"])
def test_a_missing_value_is_reported_in_tyros_form(command, capsys):
    with pytest.raises(SystemExit, match="2"):
        cmedirl.main(command.split())
    output = "".join(capsys.readouterr())
    assert "--env" in output
    assert "[--n-demos" not in output


def test_it_is_installed_under_its_name():
    done = subprocess.run(
        [sys.executable, "-c", "from cmedirl_jax.commands.entry import main; main()", "--help"],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert "Learn rewards from demonstrations" in done.stdout


def test_without_its_extra_it_says_what_to_install(monkeypatch, capsys):
    for name in list(sys.modules):
        if name.startswith("cmedirl_jax.commands."):
            monkeypatch.delitem(sys.modules, name)
    monkeypatch.delattr("cmedirl_jax.commands.cmedirl")
    monkeypatch.setitem(sys.modules, "tyro", None)
    assert entry.main() == 2
    assert "run: python -m pip install 'cmedirl-jax[cli]'" in capsys.readouterr().err
