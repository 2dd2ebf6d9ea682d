from cmedirl_jax.training.methods import METHODS, PAPER_METHODS
from experiments import curves


def test_every_method_has_one_line_in_all_figures_and_no_other_has_it():
    every = curves.lines(METHODS)
    assert len({tuple(line.values()) for line in every.values()}) == len(METHODS)
    # The paper's four differ in colour, and in grey.
    for key in ("color", "linestyle"):
        assert len({every[method][key] for method in PAPER_METHODS}) == 4
    some = curves.lines(["gail", "ddpg", "gail"])
    assert some == {method: every[method] for method in ("gail", "ddpg")}
