import pytest

from cmedirl_jax import training
from cmedirl_jax.training import methods
from cmedirl_jax.training.methods import METHODS


def test_the_papers_methods_are_the_four_combinations_of_its_two_parts():
    paper = {name: METHODS[name] for name in methods.PAPER_METHODS}
    parts = {name: (method.hot_start, method.reward) for name, method in paper.items()}
    assert parts == {
        "ddpg": (False, None),
        "hs-ddpg": (True, None),
        "me-ddpg": (False, "maxent"),
        "hs-me-ddpg": (True, "maxent"),
    }
    assert [m.uses_demonstrations for m in paper.values()] == [False, True, True, True]
    assert all(m.interacts and m.shaping == "additive" for m in paper.values())


def test_methods_go_by_their_names():
    assert all(name == method.name for name, method in METHODS.items())


@pytest.mark.parametrize("name", ["maxent-irl", "deep-maxent-irl"])
def test_methods_that_do_not_act_are_not_trained(name, env):
    assert METHODS[name].uses_demonstrations
    with pytest.raises(ValueError, match=f"{name} does not act"):
        training.make(env, METHODS[name], capacity=10)
