"""What a run is: its configuration, and the three named ones."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Literal

import tyro

from cmedirl_jax.ddpg import DDPGHParams
from cmedirl_jax.hot_start import HotStartHParams
from cmedirl_jax.irl import IRLHParams
from cmedirl_jax.methods import PAPER_METHODS, ExplorationSettings, Settings
from cmedirl_jax.schedules import RewardSchedule, Schedule
from cmedirl_jax.tabular.imitation import TabularSettings

Expert = Literal["best", "median", "all"]


@dataclasses.dataclass(frozen=True)
class ExpertSettings:
    """How the demonstrations are made: by DDPG on the true reward, with the `tuned` settings."""

    seeds: int = 16
    """Experts trained; the final policies of those that solve the task can demonstrate."""
    steps: int = 14_000
    """Environment steps of each expert."""
    trajectories: int = 1_024
    """Least number of demonstrated trajectories in the pool."""


@dataclasses.dataclass(frozen=True)
class Grid:
    """A run: methods x numbers of demonstrations x seeds, a learner's budget, its settings."""

    preset: Literal["tuned", "paper", "smoke"] = "tuned"
    """tuned: the setting that works; paper: the paper's letter; smoke: ends within a minute."""
    methods: tuple[str, ...] = PAPER_METHODS
    """Which methods to train."""
    n_demos: tuple[int, ...] = (200,)
    """Demonstrated trajectories N_T per learner; several make Figures 4 and 5."""
    seeds: int = 100
    """Independent learners per cell."""
    seed: int = 0
    """Seed of the whole study."""
    max_steps: int | None = 12_000
    """Environment steps per learner."""
    max_episodes: int | None = None
    """Episodes per learner; with max-steps, whichever comes first."""
    evaluate_every: int = 250
    """Environment steps between noise-free evaluations."""
    evaluation_starts: int = 10
    """Start states per evaluation, evenly spaced, the same for every seed and method."""
    evaluate_every_episodes: int | None = None
    """Also evaluate each learner whenever it has lived this many more episodes (the paper: 100)."""
    evaluation_starts_episodes: int = 100
    """Start states of the evaluations by episodes."""
    out: Path | None = None
    """Folder of the results; default results/PRESET."""
    expert: Expert = "best"
    """Who demonstrates: the best or median expert that solved the task, or all of them alike."""
    demos: Path | None = None
    """A demonstrations file to learn from; no experts are trained, their options say nothing."""
    env: str = "MountainCarContinuous-v0"
    """The environment, by Gymnasium's name."""
    devices: int | None = None
    """CPU devices, or GPUs, to spread the seeds over; default: every core, or every GPU. With
    several processes, of each of them."""
    group: int | None = None
    """Seeds that a device steps together; default: what is fastest for the networks' width."""
    distributed: bool = False
    """Share the run with the other processes of the cluster that JAX detects (docs/scaling.md)."""
    coordinator: str | None = None
    """Share the run with other processes: HOST:PORT of process 0, the same for all of them."""
    processes: int | None = None
    """With coordinator: how many processes there are."""
    process_id: int | None = None
    """With coordinator: which of them this is, from 0; process 0 alone writes results."""
    checkpoint_every: float = 60.0
    """Seconds from one checkpoint of the training to the next; 0: one after every chunk."""
    experts: ExpertSettings = ExpertSettings()
    settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()

    @property
    def folder(self) -> Path:
        """Where the results go."""
        out = self.out if self.out is not None else Path("results") / self.preset
        # Or making a/../b would make a.
        return Path(os.path.normpath(out))


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
    reward_schedule=RewardSchedule(period=1, stop=None, recent=None, storage="store"),
    hot_start=HotStartHParams(critic="softmax"),
    schedule=Schedule(replay_capacity=10_000, learning_starts=0, target_period=300, cloning="none"),
)

PRESETS: dict[str, Grid] = {
    "tuned": Grid(),
    "paper": Grid(
        preset="paper",
        max_steps=None,
        max_episodes=150,
        evaluate_every=1_000,
        evaluate_every_episodes=100,
        settings=_PAPER_SETTINGS,
    ),
    "smoke": Grid(
        preset="smoke",
        n_demos=(5,),
        seeds=8,
        max_steps=500,
        experts=ExpertSettings(seeds=8, steps=6_000, trajectories=64),
        settings=Settings(
            hot_start=HotStartHParams(steps=200), tabular=TabularSettings(states=25, steps=30)
        ),
    ),
}
