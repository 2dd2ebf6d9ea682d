import dataclasses
import typing

import pytest

from cmedirl_jax import ranges
from cmedirl_jax.runs import validation
from cmedirl_jax.runs.errors import UserError
from experiments.presets import PRESETS
from experiments.run_grid import parse


def fields(options, prefix=""):
    """Dotted names of the numbers that options may hold, and their ranges."""
    for name, interval in ranges.of_fields(type(options)).items():
        value = getattr(options, name)
        if dataclasses.is_dataclass(value):
            yield from fields(value, f"{prefix}{name}.")
        elif interval is not None:
            yield prefix + name, interval


RANGES = dict(fields(PRESETS["tuned"]))


def numeric(annotation):
    """Whether a field of this type may hold a number."""
    return annotation in (int, float) or any(map(numeric, typing.get_args(annotation)))


def test_every_number_that_the_command_line_takes_has_a_range():
    def unranged(options):
        types = typing.get_type_hints(type(options))
        for name, interval in ranges.of_fields(type(options)).items():
            value = getattr(options, name)
            if dataclasses.is_dataclass(value):
                yield from unranged(value)
            elif interval is None and numeric(types[name]):
                yield name

    assert not list(unranged(PRESETS["tuned"]))
    assert len(RANGES) > 70


@pytest.mark.parametrize("preset", PRESETS)
def test_the_presets_are_in_range(preset):
    validation.check(PRESETS[preset])


def beyond(of_name):
    """Words that the command line can read as a number and that are out of the range."""
    if isinstance(of_name.low, int):
        return str(of_name.low - 1), str(of_name.high + 1)
    return "nan", "inf", "-inf", "-1", str(2.0 * of_name.high)


@pytest.mark.parametrize(
    ("name", "word"), [(name, word) for name in RANGES for word in beyond(RANGES[name])]
)
def test_a_number_out_of_range_is_refused_naming_its_option(name, word):
    option = f"--{name.removeprefix('settings.').replace('_', '-')}"
    with pytest.raises(UserError) as error:
        validation.check(parse([option, word]))
    message = str(error.value)
    assert message.startswith(f"{option}: must be ")
    number = message.rpartition(", got ")[2]
    assert str(float(number)) == str(float(word))
