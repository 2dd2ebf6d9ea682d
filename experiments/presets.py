"""The three configurations with a name: `tuned`, `paper` and `smoke`."""

import dataclasses

from cmedirl_jax.agents.ddpg import DDPGHParams
from cmedirl_jax.agents.exploration import ExplorationSettings
from cmedirl_jax.agents.hot_start import HotStartHParams
from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.irl.reward_batches import RewardBatchSettings
from cmedirl_jax.runs.config import ExpertSettings, StudyConfig, of_task
from cmedirl_jax.tabular.imitation import TabularSettings
from cmedirl_jax.training import tasks
from cmedirl_jax.training.schedules import RewardSchedule, Schedule
from cmedirl_jax.training.settings import Settings

# What section 4.1 and Algorithms 1 and 2 state. What they leave open keeps the tuned value.
_PAPER_SETTINGS = Settings(
    agent=DDPGHParams(
        tau=1.0,
        actor_learning_rate=1e-5,
        critic_learning_rate=1e-5,
        pre_activation_penalty=0.0,
        bootstrap_at_termination=True,
    ),
    exploration=ExplorationSettings(kind="epsilon-greedy"),
    reward=IRLHParams(
        learning_rate=1e-5, bounded_by="none", output_penalty=0.0, prior_precision=1e-3
    ),
    reward_batches=RewardBatchSettings(recent=None),
    reward_schedule=RewardSchedule(period=1, stop=None, storage="store"),
    hot_start=HotStartHParams(critic="softmax"),
    schedule=Schedule(recent=10_000, learning_starts=0, target_period=300, cloning="none"),
)

CAR = StudyConfig().env
"""The paper's task."""
SWEEP = (1, 5, 10, 50, 100, 200)
"""The numbers of demonstrations N_T of the full grid."""

PRESETS: dict[str, StudyConfig] = {
    "tuned": StudyConfig(),
    "paper": StudyConfig(
        preset="paper",
        max_steps=None,
        max_episodes=150,
        evaluate_every=1_000,
        evaluate_every_episodes=100,
        settings=_PAPER_SETTINGS,
    ),
    "smoke": StudyConfig(
        preset="smoke",
        n_demos=(5,),
        seeds=8,
        max_steps=500,
        experts=ExpertSettings(steps=6_000, trajectories=64),
        settings=Settings(
            hot_start=HotStartHParams(steps=200), tabular=TabularSettings(states=25, steps=30)
        ),
    ),
}


def preset(name: str, grid: str = "main", env: str = CAR) -> StudyConfig:
    """The configuration of a preset, on one of the two grids; `tuned` for an unknown name.

    The task's experts have the settings that work there, see `config.of_task`; under `tuned` its
    learners too, for as many steps.
    """
    config, task = PRESETS.get(name, PRESETS["tuned"]), of_task(env)
    if config.preset == "tuned":
        config = task
    else:
        own = tasks.of(env).experts if config.preset == "paper" else task.experts.settings
        experts = dataclasses.replace(config.experts, settings=own)
        config = dataclasses.replace(config, env=env, experts=experts)
    if grid != "full":
        return config
    steps = config.max_steps
    if config.preset == "tuned" and steps is not None:
        steps = max(20_000, steps)
    return dataclasses.replace(config, grid="full", n_demos=SWEEP, max_steps=steps)
