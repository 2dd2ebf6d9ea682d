import shlex

import polars as pl
import pytest

from cmedirl_jax.runs.storage import demonstrations as stored
from experiments import run_grid, variants
from experiments.variants import VARIANTS, Variant
from tests.support import curves

OWN = "--base=--methods me-ddpg"
SLOW, FAST = [0, 20, 95], [10, 95, 95]


@pytest.fixture
def runs(tmp_path):
    """Two variants of one base, in eleven seeds; the second is as the base."""
    cells = {"base": SLOW, "fast": FAST, "same": SLOW}
    for name, curve in cells.items():
        folder = tmp_path / name
        curves.write_config(folder, methods=("me-ddpg",), n_demos=(5,), seeds=11)
        curves.save(folder, "me-ddpg", 5, [curve] * 11)
        pl.DataFrame({"method": ["me-ddpg"], "r_d_std": [0.04]}).write_csv(folder / "summary.csv")
    return tmp_path


def test_variants_are_compared_with_their_base_seed_by_seed(runs):
    chosen = [Variant("base", "--a"), Variant("fast", "--b", "base"), Variant("same", "", "base")]
    table = variants.compare(runs, chosen)
    assert table["variant"].to_list() == ["base", "fast", "same"]
    assert table["convergence_env_step_difference"].to_list() == [None, -100.0, 0.0]
    # All eight tests of the table together.
    p_value = 2 / 2**11
    assert table["area_p_holm"][1] == pytest.approx(8 * p_value, rel=0.9)
    assert table["area_p_holm"][2] == 1.0
    assert variants.shown(table).row_count == 3


def test_every_variant_has_a_base_that_comes_before_it_and_the_same_method():
    seen = {}
    for variant in VARIANTS:
        assert variant.name not in seen
        if variant.base:
            assert variant.options.startswith(f"{seen[variant.base].options} --")
        seen[variant.name] = variant


def test_a_variant_brings_its_base():
    assert [one.name for one in variants.chosen_of(["gail-log-d"])] == ["gail", "gail-log-d"]
    assert variants.chosen_of([]) == list(VARIANTS)


def test_every_variant_changes_the_settings_of_its_base():
    settings = {}
    for variant in VARIANTS:
        settings[variant.name] = run_grid.parse(shlex.split(variant.options)).settings
        assert not variant.base or settings[variant.name] != settings[variant.base]


def test_changes_may_be_switches_and_have_spaces():
    base = "--methods gail"
    options = variants.Options(base=base, changes=("reward.absorbing,gail.form='log D'",))
    _, changed = variants.variants_of(options)
    settings = run_grid.parse(shlex.split(changed.options)).settings
    assert settings.reward.absorbing
    assert settings.gail.form == "log D"


def test_a_run_that_fails_ends_the_command_with_its_code(monkeypatch):
    codes = iter([0, 3])
    monkeypatch.setattr("experiments.run_grid.execute", lambda *args, **options: next(codes))
    assert variants.main(["--demos", "pool.npz", "--only", "gail-throughout", "gail-log-d"]) == 3


def test_an_unknown_variant_is_refused_in_a_line(capsys):
    assert variants.main(["--demos", "pool.npz", "--only", "everything"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("variants: --only: there is no variant 'everything'; there are me-ddpg")
    assert error.count("\n") == 1


def test_changes_of_ones_own_are_variants_of_ones_own_base(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    run = []

    def execute(name, config, *args, **options):
        # The base's run keeps the demonstrations of its experts.
        kept = config.out / stored.FOLDER / stored.FILE
        kept.parent.mkdir(parents=True)
        kept.touch()
        run.append(config)
        return 0

    monkeypatch.setattr("experiments.run_grid.execute", execute)
    monkeypatch.setattr(variants, "compare", lambda *_: pl.DataFrame())
    monkeypatch.setattr(variants, "shown", lambda table: "")
    base = "--base=--env Pendulum-v1 --methods me-ddpg"
    changes = ["reward.bound=0.5", "agent.discount=0.9,reward-schedule.stop=None"]
    assert variants.main([base, "--seeds", "4", "--changes", *changes]) == 0
    assert [config.env for config in run] == ["Pendulum-v1"] * 3
    pool = run[0].out / stored.FOLDER / stored.FILE
    assert [config.demos for config in run] == [None, pool, pool]
    assert [config.out.name for config in run] == ["base", *changes]
    first, bound, two = (config.settings for config in run)
    assert bound.reward.bound == 0.5
    assert first.reward.bound != 0.5
    assert (two.agent.discount, two.reward_schedule.stop) == (0.9, None)
    assert two.reward == first.reward


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "--demos: the study's variants need"),
        (["--changes", "reward.bound=1"], "--base and --changes go together"),
        (["--base=--methods ddpg"], "--base and --changes go together"),
        (["--base=--n-demos 5", "--changes", "reward.bound=1"], "base: needs one method"),
        ([OWN, "--changes", "n-demos=5 10"], "n-demos=5 10: needs one method"),
        ([OWN, "--changes", "seed=1"], "seed=1: needs the task and the study seed"),
        (
            ["--base=--methods me-ddpg --seeds=4", "--changes", "reward.bound=1"],
            "base: give --seeds",
        ),
        ([OWN, "--changes", "seeds=4"], "seeds=4: give --seeds to this command"),
        ([OWN, "--changes", "gail.form='log D"], "No closing quotation"),
    ],
)
def test_options_that_do_not_go_together_are_refused(arguments, message, capsys):
    assert variants.main(arguments) == 2
    assert message in capsys.readouterr().err
