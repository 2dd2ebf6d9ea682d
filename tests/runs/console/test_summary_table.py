import io

import polars as pl
import pytest
from rich.console import Console

from cmedirl_jax.runs.console import summary_table

ROW = {
    "method": "hs-ddpg",
    "n_demos": 200,
    "seeds": 100,
    "experts": 100,
    **{"converged_fraction": 0.5, "converged_fraction_low": 0.404, "converged_fraction_high": 1.0},
    "convergence_env_step_median": 12_345.6,
    "convergence_env_step_median_low": 9_000.0,
    "convergence_env_step_median_high": None,
    **{"dip_fraction": None, "dip_fraction_low": None, "dip_fraction_high": None},
    **{"area": -1.25, "area_low": -2.0, "area_high": 0.0},
    **{"final_return_mean": 93.456, "final_return_std": 0.5},
    **{"best_return_mean": 94.0, "best_return_std": None},
}


def words(**changes):
    """The printed table's words."""
    console = Console(file=io.StringIO(), width=200)
    console.print(summary_table.of(pl.DataFrame([ROW | changes])))
    return " ".join(console.file.getvalue().split())


def test_numbers_have_their_intervals_below_them():
    shown = words()
    # Two lines of one row, column by column.
    assert "hs-ddpg 200 0.50 12,346 - -1.2 93.46 94.00" in shown
    assert "[0.40, 1.00] [9,000, ?] [-2.0, 0.0] ± 0.50" in shown


def test_a_method_without_demonstrations_has_a_dash():
    assert "ddpg - 0.50" in words(method="ddpg", n_demos=0)


@pytest.mark.parametrize(("experts", "said"), [(1, True), (2, False)])
def test_the_title_says_where_all_seeds_share_one_expert(experts, said):
    shown = words(experts=experts)
    assert "100 seeds per row; 95% intervals" in shown
    assert ("of this one expert" in shown) is said
