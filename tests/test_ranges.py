import dataclasses
import math
from typing import Annotated, Literal

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import ranges
from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.networks import Architecture
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings


def with_tau(tau):
    return dataclasses.replace(Settings(), agent=DDPGHParams(tau=tau))


def test_the_defaults_are_in_range():
    ranges.check(Settings())


NAMED = {
    name: kind.__metadata__[0]
    for name, kind in vars(ranges).items()
    if isinstance(getattr(kind, "__metadata__", (None,))[0], ranges.Range)
}


@pytest.mark.parametrize("name", NAMED)
def test_a_range_holds_its_ends_and_nothing_beyond_or_undefined(name):
    interval = NAMED[name]
    one = dataclasses.make_dataclass("One", [("number", getattr(ranges, name))])

    def wrong(value):
        return list(ranges.out_of_range(one(value)))

    assert not wrong(interval.low)
    assert not wrong(interval.high)
    beyond = math.nextafter(interval.low, -math.inf), math.nextafter(interval.high, math.inf)
    for outside in (*beyond, math.inf, -math.inf):
        ((name, what),) = wrong(outside)
        assert name == "number"
        assert what.endswith(f", got {outside}")
    assert wrong(math.nan) == [("number", f"must be {interval.words}, got nan")]


def test_a_string_that_is_none_of_the_choices_is_refused():
    fruit = Literal["apple", "pear"]
    basket = dataclasses.make_dataclass(
        "Basket",
        [("one", fruit), ("some", tuple[fruit, ...]), ("none", fruit | None), ("any", str)],
    )
    assert not list(ranges.out_of_range(basket("pear", ("apple",), None, "plum")))
    assert list(ranges.out_of_range(basket("plum", ("apple", "fig"), "nut", ""))) == [
        ("one", "must be one of apple, pear, got 'plum'"),
        ("some", "must be one of apple, pear, got 'fig'"),
        ("none", "must be one of apple, pear, got 'nut'"),
    ]


def test_names_of_a_registry_are_left_to_it():
    fruit = Annotated[Literal["apple", "pear"], ranges.Registered]
    basket = dataclasses.make_dataclass("Basket", [("one", fruit)])
    assert not list(ranges.out_of_range(basket("plum")))


def test_a_range_is_found_in_optional_fields_and_in_tuples():
    nested = dataclasses.make_dataclass("Nested", [("sizes", tuple[ranges.Size, ...])])
    whole = dataclasses.make_dataclass(
        "Whole", [("limit", ranges.Count | None), ("nested", nested), ("name", str)]
    )
    assert not list(ranges.out_of_range(whole(None, nested(()), "any")))
    assert list(ranges.out_of_range(whole(-1, nested((1, 0)), "any"))) == [
        ("limit", "must be at least 0, got -1"),
        ("nested.sizes", "must be at least 1, got 0"),
    ]


def test_a_number_without_a_range_is_a_type_error():
    forgotten = dataclasses.make_dataclass("Forgotten", [("number", float)])
    with pytest.raises(TypeError, match="number has no range"):
        ranges.check(forgotten(1.0))


def test_what_32_bits_cannot_hold_is_out_of_range():
    ((_, wrong),) = ranges.out_of_range(with_tau(1e-50))
    assert wrong == "must be above 0 and at most 1, got 1e-50"
    settings = dataclasses.replace(Settings(), architecture=Architecture(hidden=(64, 2**31)))
    ((_, wrong),) = ranges.out_of_range(settings)
    assert wrong == "must be at most 2^31 - 1, got 2147483648"


def test_composition_names_numbers_out_of_range(spec):
    with pytest.raises(ValueError, match=r"^agent.tau must be above 0 and at most 1, got -1$"):
        compose.compose(spec, METHODS["ddpg"], with_tau(-1), capacity=10)


def test_arrays_on_the_host_are_checked_and_traced_ones_pass():
    def tau(value):
        settings = with_tau(value)
        ranges.check(settings)
        return settings.agent.tau

    np.testing.assert_array_equal(jax.jit(jax.vmap(tau))(jnp.array([0.5, -1.0])), [0.5, -1.0])
    ranges.check(with_tau(jnp.array([0.5, 1.0])))
    for wrong, said in ((jnp.array(-1.0), "-1.0"), (np.array([0.5, np.nan]), r"nan at \[1\]")):
        with pytest.raises(ValueError, match=f"^agent.tau must be above 0 .*, got {said}$"):
            ranges.check(with_tau(wrong))
