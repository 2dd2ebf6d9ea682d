import typing

import pytest

from cmedirl_jax import ranges
from cmedirl_jax.agents import exploration
from cmedirl_jax.irl import objectives, rewards
from cmedirl_jax.registries import Registry


def test_an_unknown_name_is_refused_with_the_known_ones():
    registry = Registry("fruit", {"apple": 1, "pear": 2})
    assert registry["pear"] == 2
    with pytest.raises(ValueError, match=r"^unknown fruit 'plum'; there are: apple, pear$"):
        registry["plum"]


def test_an_added_entry_is_found_and_listed():
    registry = Registry("fruit", {})
    registry["apple"] = 1
    assert registry["apple"] == 1
    with pytest.raises(ValueError, match="there are: apple"):
        registry["pear"]


@pytest.mark.parametrize(
    ("names", "registry"),
    [
        (exploration.ExplorationName, exploration.EXPLORATIONS),
        (objectives.ObjectiveName, objectives.OBJECTIVES),
        (rewards.NetworkName, rewards.NETWORKS),
    ],
    ids=["exploration", "objective", "reward network"],
)
def test_the_command_line_offers_every_entry(names, registry):
    choices, *marks = typing.get_args(names)
    assert typing.get_args(choices) == tuple(registry)
    # Entries of users are not among them, and are not refused.
    assert ranges.Registered in marks
