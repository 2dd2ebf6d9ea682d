import pytest

from cmedirl_jax.runs.errors import UserError
from experiments import claims, pooled
from experiments.presets import PRESETS
from experiments.verdicts import Claim, Part
from tests.support.curves import SEEDS, save, write_config


@pytest.fixture
def folder(tmp_path):
    write_config(tmp_path, methods=("ddpg", "hs-ddpg"), n_demos=(5,))
    save(tmp_path, "ddpg", 0, [[0, 20, 95]] * SEEDS)
    save(tmp_path, "hs-ddpg", 5, [[95, 95, 95]] * SEEDS)
    return tmp_path


def test_the_page_names_the_runs_and_judges_all_ten_claims(folder):
    text = claims.of_folders([folder])
    assert f"- {SEEDS} seeds x 200 steps, study seeds 0, experts: each; ddpg, hs-ddpg 5" in text
    rows = [line for line in text.splitlines() if line.startswith("| C")]
    assert [row.split(" | ")[0] for row in rows] == [f"| C{n}" for n in range(1, 11)]
    assert "hs-ddpg (N_T 5) against ddpg, convergence_env_step: -200 [-200, -200]" in text
    assert str(folder) not in text


def test_the_command_writes_the_page_or_prints_it(folder, tmp_path, capsys):
    out = tmp_path / "new" / "claims.md"
    assert claims.main([str(folder), "--out", str(out)]) == 0
    assert claims.main([str(folder)]) == 0
    assert capsys.readouterr().out.rstrip() == out.read_text().rstrip()


def test_runs_of_other_settings_are_not_judged_together(folder, tmp_path):
    other = tmp_path / "other"
    write_config(other, methods=("ddpg",), preset="paper", settings=PRESETS["paper"].settings)
    save(other, "ddpg", 0, [[0, 20, 95]] * SEEDS)
    with pytest.raises(UserError, match=r"its \S+ is not that of"):
        claims.of_folders([folder, other])


def test_a_run_of_another_task_is_not_judged(folder, monkeypatch):
    run = pooled.load(folder)
    other = run._replace(config=run.config | {"env": "PointMass-v0"})
    assert claims.verdicts_on(run) is not None
    on_host = run._replace(config=run.config | {"env": "gymnasium:MountainCarContinuous-v0"})
    assert claims.verdicts_on(on_host) is not None
    assert claims.verdicts_on(other) is None
    monkeypatch.setattr(pooled, "load", lambda folder: other)
    with pytest.raises(UserError, match=r"PointMass-v0; the paper's claims are about Mountain"):
        claims.of_folders([folder])


def test_the_section_of_a_report_has_every_verdict_and_its_evidence():
    judged = [
        Claim("C1", "Methods & more", (Part("a < b", "yes"),)),
        Claim("C2", "Others", (Part("c", "no"),)),
        Claim("C10", "Proofs", (), "none is given"),
    ]
    text = claims.section(judged)
    for line in ("Methods &amp; more", "yes: a &lt; b", "not supported", "none is given"):
        assert line in text
    assert text.count("<tr>") == 4


@pytest.mark.parametrize(
    ("arguments", "named"), [([], "give the folder of a run"), (["nowhere"], "holds no run")]
)
def test_mistakes_are_refused_in_a_line(arguments, named, capsys):
    assert claims.main(arguments) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1


def test_one_seed_is_not_judged(tmp_path):
    write_config(tmp_path, methods=("ddpg",), seeds=1)
    save(tmp_path, "ddpg", 0, [[0, 20, 95]])
    with pytest.raises(UserError, match="one seed has no interval"):
        claims.of_folders([tmp_path])
