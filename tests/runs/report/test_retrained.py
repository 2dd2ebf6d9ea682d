"""Fresh agents on a run's rewards: what is asked, and what is measured."""

from typing import NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
import pytest

from cmedirl_jax import envs
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report import retrained, reward_cards
from cmedirl_jax.runs.report.reward_samples import Context, Learners, RewardedRun
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.types import Transition
from tests.support import pools, trainers

CAR = envs.make("MountainCarContinuous-v0")


def test_agents_are_measured_at_the_end_against_those_on_the_tasks_reward():
    rows = [
        {"method": method, "n_demos": n_demos, "seed": seed, "physics": physics}
        | {"env_step": step, "return_mean": base + step + seed, "goal_fraction": 0.5}
        for method, n_demos, base in (("r_e", 0, 50.0), ("gail", 5, 20.0))
        for seed in range(2)
        for physics in ("own", "power=2")
        for step in range(5)
    ]
    agents = retrained.measured(pl.DataFrame(rows))
    assert agents.height == 8
    own = agents.filter(pl.col("physics") == "own").sort("method", "seed")
    assert own["return"].to_list() == [23.5, 24.5, 53.5, 54.5]
    assert own["regret"].to_list() == [30.0, 30.0, 0.0, 0.0]
    seeds = agents.select("method", "n_demos", "seed", expert_id=pl.lit(None, pl.Int32)).unique()
    summary = reward_cards.summarise(agents, seeds, retrained.MEASURES)
    assert summary.height == 2 * 2 * len(retrained.MEASURES)
    assert summary["seeds"].to_list() == [2] * summary.height
    figure = retrained.figure(pl.DataFrame(rows), seeds, 90.0)
    assert [axes.get_title() for axes in figure.axes] == ["own physics", "power=2"]


def planned(*changes, steps=120, env=CAR):
    return retrained.plan(env, steps, changes, [])


def test_physics_are_changed_by_name():
    physics = planned("power=0.001", "start_low=-0.9,start_high=-0.7,max_episode_steps=50").physics
    assert list(physics) == [
        "own",
        "power=0.001",
        "start_low=-0.9,start_high=-0.7,max_episode_steps=50",
    ]
    own, weak, short = physics.values()
    assert own == CAR.default_params
    assert weak == own.replace(power=0.001)
    assert short == own.replace(start_low=-0.9, start_high=-0.7, max_episode_steps=50)
    assert isinstance(short.max_episode_steps, int)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (("mass=2",), "mass=2 names none of the task's parameters: power, gravity"),
        (("power=much",), "power=much gives no number as 0.0015 is"),
        (("power=inf",), "power=inf is not finite"),
        (("max_episode_steps=1.5",), "gives no number as 999 is"),
        ((f"max_episode_steps={10**30}",), "gives no number as 999 is"),
    ],
)
def test_other_physics_are_refused(changes, said):
    with pytest.raises(UserError, match=f"--physics: .*{said}"):
        planned(*changes)


def test_what_cannot_be_retrained_is_refused():
    with pytest.raises(UserError, match="--retrain: 100 is no multiple of 8"):
        planned(steps=100)
    with pytest.raises(UserError, match="goal is no single number"):
        planned("goal=1", env=envs.make("PointMass-v0"))


def test_physics_of_any_dataclass_and_tuple():
    class Pair(NamedTuple):
        mass: float = 1.0
        heavy: bool = False

    @flax.struct.dataclass
    class Fields:
        mass: float = 1.0

    tasks = [CAR._replace(default_params=params) for params in (Pair(), Fields())]
    found = [planned("mass=2", env=env).physics["mass=2"].mass for env in tasks]
    assert found == [2.0, 2.0]
    with pytest.raises(UserError, match="heavy is no single number"):
        planned("heavy=True", env=tasks[0])
    with pytest.raises(UserError, match="parameters: none"):
        planned("mass=2", env=CAR._replace(default_params=()))


def test_all_rewards_but_the_tasks_are_paid_at_one_size(monkeypatch):
    seeds, visited = 2, 16
    rng = np.random.default_rng(0)
    shape = {"observation": (2,), "action": (1,), "next_observation": (2,)}
    steps = Transition(
        **{
            name: np.float32(0.1 * rng.normal(size=(seeds, visited, *shape.get(name, ()))))
            for name in Transition._fields
        }
    )

    def learners(method, scale):
        def reward(params, observation, action):
            return params * (observation[..., 0] + action[..., 0])

        rewards = Rewards(reward, np.float32([scale, 2.0 * scale]))
        return Learners(
            *(METHODS[method], 1, trainers.SMALL, np.arange(seeds), rewards),
            demonstrated=steps,
            played=steps,
            held_out=None,
        )

    def retrain(keys, env, rewards, physics, **budget):
        """In place of a return: the root mean square of what an agent is paid."""
        paid = jnp.zeros(seeds)
        if rewards is not None:
            pay = jax.vmap(rewards.reward)(rewards.params, steps.observation, steps.action)
            paid = jnp.sqrt(jnp.mean(jnp.square(pay), axis=1))
        paid = jnp.broadcast_to(paid[:, None, None], (seeds, 1, 1 + retrained.EVALUATIONS))
        return Evaluation(*[paid] * len(Evaluation._fields))

    monkeypatch.setattr(retrained.retraining, "retrain", retrain)
    context = Context(CAR, pools.scripted(), 0.99, seeds, jax.random.key(0))
    run = RewardedRun(context, [learners("me-ddpg", 0.01), learners("irl-only", 1000.0)], 0)
    said = []
    plan = retrained.plan(CAR, 64, [], jax.devices()[:1])
    tables = {table["method"][0]: table for table in retrained.of_run(run, plan, said.append)}
    assert list(tables) == ["r_e", "random", "+constant", "-constant", "me-ddpg", "irl-only"]
    assert (tables.pop("r_e")["return_mean"] == 0.0).all()
    paid = np.array([table["return_mean"] for table in tables.values()])
    learned = np.abs(steps.observation[..., 0] + steps.action[..., 0])
    sizes = np.sqrt(np.mean(np.square(learned), axis=1)) * [1.0, 2.0]
    np.testing.assert_allclose(paid, np.mean([0.01, 1000.0]) * sizes.mean(), rtol=1e-4)
    assert said[0].startswith("Root mean squares as learned: ")
