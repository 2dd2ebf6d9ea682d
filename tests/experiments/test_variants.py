import polars as pl
import pytest

from experiments import variants
from experiments.variants import VARIANTS, Variant
from tests.support import curves

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


@pytest.mark.parametrize("variant", [one for one in VARIANTS if one.base], ids=lambda one: one.name)
def test_the_options_of_a_variant_are_run_grids(variant, monkeypatch):
    parsed = []

    def ending_with(code):
        return lambda _, config, *args, **options: parsed.append(config.settings) or code

    monkeypatch.setattr("experiments.run_grid.execute", ending_with(3))
    code = variants.main(["--demos", "pool.npz", "--only", variant.name])
    assert code == 3
    monkeypatch.setattr("experiments.run_grid.execute", ending_with(0))
    monkeypatch.setattr(variants, "compare", lambda *_: pl.DataFrame())
    monkeypatch.setattr(variants, "shown", lambda table: "")
    assert variants.main(["--demos", "pool.npz", "--only", variant.name]) == 0
    *_, base, changed = parsed
    assert base != changed


def test_an_unknown_variant_is_refused_in_a_line(capsys):
    assert variants.main(["--demos", "pool.npz", "--only", "everything"]) == 2
    error = capsys.readouterr().err
    assert error.startswith("variants: --only: there is no variant 'everything'; there are me-ddpg")
    assert error.count("\n") == 1
