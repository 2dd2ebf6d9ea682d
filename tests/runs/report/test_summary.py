import polars as pl
import pytest

from cmedirl_jax.runs.report import summary
from tests.support import cells


def cell(method, n_demos, *returns):
    """Tables of a cell whose seeds have these returns at steps 0, 100, ..."""
    labels = {"study": 0, "method": method, "n_demos": n_demos}
    evaluations = pl.DataFrame(
        {**labels, "expert": "each", "protocol": "steps", "seed": seed, "episode": index}
        | {"env_step": 100 * index, "return_mean": value, "r_d_mean": None, "r_d_std": None}
        for seed, of_seed in enumerate(returns)
        for index, value in enumerate(of_seed)
    )
    return evaluations, cells.seeds_table(len(returns), **labels)


def tables(*of_cells):
    evaluations, seeds = zip(*of_cells, strict=True)
    return {
        "evaluations": pl.concat(evaluations),
        # The order of the seeds' rows does not count.
        "seeds": pl.concat(seeds[::-1], how="diagonal"),
    }


def test_a_row_for_each_cell_in_the_order_of_the_evaluations():
    found = summary.summarise(
        tables(
            cell("me-ddpg", 10, [0.0, 95.0], [0.0, 91.0]),
            cell("ddpg", 0, [0.0, 10.0], [0.0, 90.0], [0.0, 20.0]),
            cell("me-ddpg", 5, [0.0, 0.0]),
        ),
        threshold=90.0,
        max_episodes=None,
    )
    assert found.select("method", "n_demos", "seeds").rows() == [
        ("me-ddpg", 10, 2),
        ("ddpg", 0, 3),
        ("me-ddpg", 5, 1),
    ]
    assert found["final_return_mean"].to_list() == [93.0, 40.0, 0.0]
    assert found["converged_fraction"].to_list() == pytest.approx([1.0, 1 / 3, 0.0])


def test_a_method_that_never_acts_has_no_steps_until_it_converged():
    found = summary.summarise(
        tables(cell("bc", 10, [95.0], [0.0]), cell("ddpg", 0, [95.0], [0.0])),
        threshold=90.0,
        max_episodes=None,
    )
    assert found["final_return_mean"].to_list() == [47.5, 47.5]
    assert found["convergence_env_step_median"].is_null().to_list() == [True, False]


def test_a_cell_is_called_by_its_demonstrations_where_it_has_some():
    assert summary.cell_label("gail", 200) == "gail (N_T 200)"
    assert summary.cell_label("ddpg", 0) == "ddpg"
