"""Gymnasium's tasks as this library's."""

import gymnasium
import numpy as np
import pytest

from cmedirl_jax import envs
from cmedirl_jax.envs import pendulum, playing
from tests.support.host_tasks import Counting, Dock

BOX = gymnasium.spaces.Box


def test_the_specification_is_the_tasks_own():
    spec = envs.from_gymnasium("Pendulum-v1").spec
    for name, value in spec._asdict().items():
        np.testing.assert_array_equal(value, getattr(pendulum.SPEC, name), err_msg=name)
    car = envs.from_gymnasium("gymnasium:MountainCarContinuous-v0").spec
    assert (car.id, car.reward_threshold) == ("gymnasium:MountainCarContinuous-v0", 90.0)


def test_what_it_does_not_say_can_be_given():
    task = envs.from_gymnasium(Dock, max_episode_steps=7, reward_threshold=-3.0)
    assert task.spec.id == "Dock"
    assert (task.spec.max_episode_steps, task.spec.reward_threshold) == (7, -3.0)
    np.testing.assert_array_equal(task.spec.action_low, np.float32([-0.5]))
    assert np.isinf(task.spec.observation_high).all()
    vector = task.vector(2)
    vector.reset(seed=0)
    for _ in range(7):
        *_, truncated, _ = vector.step(np.ones((2, 1), np.float32))
    assert truncated.all()


def test_arguments_and_wrappers_reach_every_sub_environment():
    task = envs.from_gymnasium(
        "Pendulum-v1", wrappers=[lambda env: gymnasium.wrappers.RescaleAction(env, -1, 1)], g=2.5
    )
    assert task.spec.action_high == 1.0
    assert [env.unwrapped.g for env in task.vector(3).envs] == [2.5, 2.5, 2.5]


@pytest.mark.parametrize(
    ("observations", "actions", "message"),
    [
        (BOX(-1, 1, (2,)), gymnasium.spaces.Discrete(3), "its actions are Discrete.3.; DDPG's are"),
        (
            gymnasium.spaces.Dict(a=BOX(-1, 1, (2,)), b=BOX(-1, 1, (1,))),
            BOX(-1, 1, (1,)),
            "its observations are Dict.*as gymnasium.wrappers.FlattenObservation does",
        ),
        (gymnasium.spaces.Discrete(5), BOX(-1, 1, (1,)), "its observations are Discrete.5."),
        (BOX(0, 255, (4, 4, 3)), BOX(-1, 1, (1,)), r"observations are of shape \(4, 4, 3\)"),
        (BOX(-1, 1, (2,)), BOX(-1, 1, (2, 2)), r"actions are of shape \(2, 2\), not a Box"),
        (BOX(-1, 1, (2,)), BOX(-np.inf, 1, (1,)), "no bounds; give wrappers that bound them"),
        (BOX(-1, 1, (2,)), gymnasium.spaces.MultiBinary(2), "its actions are MultiBinary"),
        (BOX(-1, 1, (2,)), BOX(-3, 3, (1,), np.int32), "its actions are int32; DDPG's are"),
    ],
    ids=str,
)
def test_spaces_that_do_not_fit_are_refused_with_what_is_possible(observations, actions, message):
    def make():
        env = Dock()
        env.observation_space, env.action_space = observations, actions
        return env

    with pytest.raises(ValueError, match=message):
        envs.from_gymnasium(make, max_episode_steps=9)


def test_a_dictionary_is_flattened_by_the_wrapper_that_the_message_names():
    class Parts(Dock):
        observation_space = gymnasium.spaces.Dict(a=BOX(-9, 9, (1,)), b=BOX(-9, 9, (1,)))

        def _observe(self):
            return {"a": np.float32([self.place]), "b": np.float32([self.speed])}

    flat = [gymnasium.wrappers.FlattenObservation]
    task = envs.from_gymnasium(Parts, wrappers=flat, max_episode_steps=9)
    assert task.spec.observation_dim == 2
    assert task.vector(1).reset(seed=0)[0].shape == (1, 2)


class Odd(Dock):
    """Gives `observation` and `reward`, and infos that no vector can stack."""

    def __init__(self, observation=(0.0, 0.0), reward=0.0):
        self.observation, self.reward, self.episodes = np.asarray(observation), reward, 0

    def reset(self, *, seed=None, options=None):
        gymnasium.Env.reset(self, seed=seed)
        assert options is None
        self.episodes += 1
        return self.observation, {"episodes": [None] * self.episodes}

    def step(self, action):
        return self.observation, self.reward, False, False, {"seed": self.np_random_seed or None}


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"observation": [[0.0, 0.0]]}, "an observation of reset is .*not finite numbers of shape"),
        ({"observation": [0.0, np.nan]}, "an observation of reset is .*nan"),
        ({"reward": np.zeros(1)}, r"a reward is array\(\[0.\]\), not finite numbers of shape \(\)"),
        ({"reward": None}, "a reward is None"),
        ({"colour": "red"}, r"Odd cannot be made \(TypeError: .*colour"),
    ],
    ids=str,
)
def test_a_task_that_does_not_give_what_it_says_is_refused(given, message):
    with pytest.raises(ValueError, match=message):
        envs.from_gymnasium(Odd, max_episode_steps=3, **given)


def test_infos_and_options_are_nobodys_concern():
    task = envs.from_gymnasium(Odd, max_episode_steps=2, reward=np.int64(3))
    played = list(playing.play(task.vector(3), lambda seen: seen[:, :1], np.ones((3, 2), int), 2))
    assert [step.answer.reward.tolist() for step in played] == [[3.0] * 3] * 4


def test_a_time_limit_is_never_beyond_the_tasks_own():
    assert envs.from_gymnasium("Pendulum-v1", max_episode_steps=500).spec.max_episode_steps == 500
    vector = envs.from_gymnasium("Pendulum-v1", max_episode_steps=300).vector(1)
    vector.reset(seed=0)
    flags = [vector.step(np.zeros((1, 1), np.float32))[3][0] for _ in range(300)]
    assert flags == [False] * 299 + [True]
    with pytest.raises(ValueError, match="it ends after 60 steps, before max_episode_steps"):
        envs.from_gymnasium(lambda: gymnasium.make("Dock-v0"), max_episode_steps=61)


def test_a_task_without_a_time_limit_is_refused():
    with pytest.raises(ValueError, match="Counting: it has no time limit; give max_episode_steps"):
        envs.from_gymnasium(Counting)


def test_names_are_ours_first_and_gymnasiums_otherwise():
    assert isinstance(envs.find("Pendulum-v1"), envs.Env)
    assert isinstance(envs.find("gymnasium:Pendulum-v1"), envs.HostEnv)
    assert envs.find("tests.support.host_tasks:Dock-v0").spec.max_episode_steps == 60
    with pytest.raises(ValueError, match=r"unknown environment 'No-v0'; there are: .*Pendulum-v1"):
        envs.find("No-v0")
    with pytest.raises(ValueError, match=r"nothing:No-v0 cannot be made \(ModuleNotFoundError: No"):
        envs.find("nothing:No-v0")


@pytest.mark.parametrize(
    ("name", "sizes"), [("InvertedPendulum-v5", (4, 1)), ("Reacher-v5", (10, 2))]
)
def test_tasks_of_mujoco(name, sizes):
    pytest.importorskip("mujoco")
    task = envs.from_gymnasium(name)
    assert (task.spec.observation_dim, task.spec.action_dim) == sizes
    observations, _ = task.vector(2).reset(seed=[3, 3])
    np.testing.assert_array_equal(observations[0], observations[1])
