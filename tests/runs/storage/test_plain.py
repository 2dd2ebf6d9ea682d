import dataclasses
import json
import math

import numpy as np
import pytest

from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.networks import Architecture
from cmedirl_jax.runs.storage import plain
from cmedirl_jax.training.settings import Settings
from experiments.presets import PRESETS


def through_json(value):
    text = json.dumps(plain.plain(value), allow_nan=False)
    return json.loads(text)


@pytest.mark.parametrize("name", PRESETS)
def test_settings_come_back_equal(name):
    before = PRESETS[name].settings
    assert plain.settings(Settings, through_json(before)) == before


def test_infinities_nones_and_tuples_come_back():
    before = Settings(
        architecture=Architecture(hidden=()),
        agent=DDPGHParams(tau=1),
        reward=IRLHParams(gauge_rate=math.inf, weight_limit=2.5, absorbing=True),
    )
    after = plain.settings(Settings, through_json(before))
    assert after == before
    assert after.architecture.hidden == ()
    assert isinstance(after.agent.tau, float)


@pytest.mark.parametrize("change", [{"more": 1}, {"tau": None}])
def test_other_settings_are_named(change):
    written = through_json(DDPGHParams())
    written = {k: v for k, v in (written | change).items() if v is not None or k not in change}
    (name,) = change
    with pytest.raises(ValueError, match=rf"other settings \({name}\)"):
        plain.settings(DDPGHParams, written)


def test_a_task_comes_back_with_its_bounds(skewed_spec):
    infinite = skewed_spec._replace(
        observation_high=np.array([np.inf, 0.5, 10.0], np.float32), reward_threshold=None
    )
    for before in (skewed_spec, infinite):
        after = plain.spec(through_json(before))
        for name, value in before._asdict().items():
            np.testing.assert_array_equal(getattr(after, name), value)
            if isinstance(value, np.ndarray):
                assert getattr(after, name).dtype == np.float32


def test_no_setting_is_left_out():
    assert through_json(Settings()).keys() == {field.name for field in dataclasses.fields(Settings)}
