import polars as pl

from cmedirl_jax.runs.report import curves
from cmedirl_jax.training.methods import METHODS, PAPER_METHODS


def test_every_method_has_one_line_in_all_figures_and_no_other_has_it():
    every = curves.lines(METHODS)
    assert len({tuple(line.values()) for line in every.values()}) == len(METHODS)
    # The paper's four differ in colour, and in grey.
    for key in ("color", "linestyle"):
        assert len({every[method][key] for method in PAPER_METHODS}) == 4
    some = curves.lines(["gail", "ddpg", "gail"])
    assert some == {method: every[method] for method in ("gail", "ddpg")}


def test_evaluations_by_episodes_are_drawn_at_the_median_of_their_episodes():
    at = {0: (0, 10, 21), 1: (0, 12, 20), 2: (0, 11, 23)}
    rows = [
        {"method": "ddpg", "n_demos": 0, "seed": seed, "protocol": protocol}
        | {"env_step": 100 * episode, "episode": episode}
        for seed, episodes in at.items()
        for protocol, own in (("steps", (0, 5)), ("episodes", episodes[1:]))
        for episode in own
    ]
    table = pl.DataFrame(rows).sample(fraction=1.0, shuffle=True, seed=0)
    rows, column, _ = curves.over(table, by_episodes=True)
    assert rows.sort("seed", "env_step")[column].to_list() == [0, 11, 21] * 3
    rows, column, _ = curves.over(table, by_episodes=False)
    assert sorted(rows[column].to_list()) == [0] * 3 + [500] * 3
