import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import envs
from experiments import portraits
from tests.support import pools


def test_the_command_draws_a_panel_for_each_method(untrained_run, tmp_path, capsys):
    out = tmp_path / "portraits.svg"
    assert (
        portraits.main([str(untrained_run), "--seeds", "2", "--states", "15", "--out", str(out)])
        == 0
    )
    text = out.read_text()
    assert text.startswith("<?xml")
    assert capsys.readouterr().out == f"Portraits: {out}\n"


def test_an_episode_ends_at_the_goal_or_at_the_time_limit():
    env = pools.ENV
    there = portraits.episode(lambda observation: 0.8 * jnp.sign(observation[1:] + 1e-9), env)
    assert 50 < len(there) < 200
    assert there[-1, 0] >= 0.45 > there[:-1, 0].max()
    nothing = portraits.episode(lambda observation: jnp.zeros(1), env)
    assert nothing.shape == (1_000, 2)
    np.testing.assert_allclose(nothing[0], [-0.5, 0.0], atol=1e-6)


def test_the_value_is_the_goals_reward_beside_the_goal_and_less_far_from_it():
    first, second, value = portraits.value_map(pools.ENV, 0.99, 21, 5)
    assert value.shape == (len(first), len(second)) == (21, 21)
    fast = value[:, -1]
    assert fast[-3] == pytest.approx(100.0, abs=0.2)
    assert fast[0] < fast[-3]


def test_a_panel_shows_every_path():
    best = portraits.ValueMap(np.arange(3.0), np.arange(2.0), np.zeros((3, 2)))
    paths = [np.array([[0.0, 0.0], [1.0, 0.5]])] * 3
    figure = portraits.portraits(best, dict.fromkeys(("ddpg", "hs-ddpg"), paths))
    titled = [axes for axes in figure.axes if axes.get_title()]
    assert [axes.get_title() for axes in titled] == ["DDPG", "HS-DDPG"]
    # A line and an end for each.
    assert [len(axes.lines) for axes in titled] == [6, 6]


def test_another_number_of_observations_cannot_be_drawn():
    env = envs.make("MountainCarContinuous-v0")
    other = env._replace(spec=env.spec._replace(observation_dim=3))
    with pytest.raises(ValueError, match="two observations and one action"):
        portraits.value_map(other, 0.99, 5, 3)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["nowhere"], "nowhere: holds no run"),
        (["{run}", "--seeds", "3", "--states", "5"], "holds no method ddpg, seed 2"),
        (["{run}", "--out", "a.pdf"], "--out: a.pdf is no PNG or SVG file"),
        (["{run}", "--states", "1"], "--states: must be at least 2, got 1"),
    ],
)
def test_mistakes_are_refused_in_a_line(untrained_run, arguments, named, capsys):
    assert portraits.main([argument.format(run=untrained_run) for argument in arguments]) == 2
    error = capsys.readouterr().err
    assert named in error
    assert error.count("\n") == 1
