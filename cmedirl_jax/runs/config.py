"""The configuration of a run, as the command line and presets give it."""

import dataclasses
import os
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import tyro

from cmedirl_jax.data.formats.reading import Actions
from cmedirl_jax.ranges import Count, NotNegative, Range, Size
from cmedirl_jax.runs.cluster.base import ClusterOptions
from cmedirl_jax.training import tasks
from cmedirl_jax.training.methods import PAPER_METHODS
from cmedirl_jax.training.settings import Settings

Expert = Literal["each", "best", "median", "all"]
DemosCheck = Literal["dynamics", "spec", "none"]


@dataclasses.dataclass(frozen=True)
class ExpertSettings:
    """How the demonstrations are made: by DDPG on the true reward, with the `tuned` settings.

    Attributes:
        seeds: Experts trained; the final policies of those that solve the task can demonstrate.
            Default: one for each learner, or 16 where learners share an expert.
        steps: Environment steps of each expert.
        trajectories: Trajectories that a learner draws its demonstrations from, at least. Default:
            200 of its own expert, or 1,024 that all share; more if n-demos asks for more.
        settings: What they train with: the task's, see `training.tasks`; None: what the learners
            train with.
    """

    seeds: Size | None = None
    steps: Size = 14_000
    trajectories: Size | None = None
    settings: tyro.conf.Suppress[Settings | None] = Settings()


class Experts(NamedTuple):
    """Who demonstrates in a run, and how they are made, with every default filled in.

    Attributes:
        which: who demonstrates.
        seeds: experts trained.
        steps: environment steps of each.
        trajectories: that a learner draws its demonstrations from, at least.
        settings: what the experts train with.
    """

    which: Expert
    seeds: int
    steps: int
    trajectories: int
    settings: Settings = Settings()


@dataclasses.dataclass(frozen=True)
class RunConfig:
    """A run: methods x numbers of demonstrations x seeds, a learner's budget, its settings.

    Attributes:
        env: The task, by its name: one of this library's, or else Gymnasium's, MODULE:NAME too.
        demos: Demonstrations to learn from: a file or folder of any format (docs/data.md), or the
            id of a dataset of Minari's; default: those of experts that are trained first.
        demos_format: Its format, where it does not look like what it is.
        demos_actions: What happens to demonstrated actions out of bounds.
        check_demos: What is asked of that file. dynamics: that each step is the task's own, where
            the task can be set to an observation; spec: the task's name and bounds, and that steps
            follow each other, for tasks that draw random numbers; none: the task's sizes, for
            noisy demonstrations or those of another task.
        methods: Which methods to train.
        n_demos: Demonstrated trajectories N_T per learner; by default also all that --demos holds,
            where it holds fewer.
        seeds: Independent learners per cell.
        seeds_at_once: Of these, how many train together; the next ones follow, so that memory is
            theirs. Experts have no blocks: with --experts.seeds fewer train, and learners share
            them. Default: all.
        seed: Seed of the whole run.
        max_steps: Environment steps per learner.
        max_episodes: Episodes per learner; with max-steps, whichever comes first.
        evaluate_every: Environment steps between noise-free evaluations.
        evaluation_starts: Start states per evaluation, the same for every seed and method; they
            weigh as the task draws them.
        out: Folder of the results.
        asynchronous: Step each learner's copy of a task of Gymnasium's in a process of its own,
            for slow tasks.
        devices: CPU devices, or GPUs, to spread the seeds over; default: every core, or every GPU,
            and for a task on the host a core for each 32 seeds. With several processes, of each.
        group: Seeds that a device steps together; default: what is fastest for the networks' width.
        checkpoint_every: Seconds from one checkpoint of the training to the next; 0: one after
            every chunk.
        log: Loggers that write each cell's evaluations to OUT/log while it trains: csv,
            tensorboard, wandb (offline); the last two need the extra log.
        log_seeds: Also log each seed, beside the means over the seeds.
    """

    env: str = "MountainCarContinuous-v0"
    demos: Path | None = None
    demos_format: str | None = None
    demos_actions: Actions = "refuse"
    check_demos: DemosCheck = "dynamics"
    methods: Annotated[tuple[str, ...], tyro.conf.arg(aliases=("--method",))] = PAPER_METHODS
    n_demos: tuple[Size, ...] = (200,)
    seeds: Size = 100
    seeds_at_once: Size | None = None
    seed: Annotated[int, Range(0, 2**32 - 1, "between 0 and 2^32 - 1")] = 0
    max_steps: Size | None = 12_000
    max_episodes: Size | None = None
    evaluate_every: Size = 250
    evaluation_starts: Size = 10
    out: Path | None = None
    asynchronous: bool = False
    devices: Size | None = None
    group: Size | None = None
    checkpoint_every: NotNegative = 60.0
    log: tuple[str, ...] = ()
    log_seeds: bool = False
    settings: Annotated[Settings, tyro.conf.arg(name="")] = Settings()


@dataclasses.dataclass(frozen=True)
class StudyConfig(RunConfig):
    """A study: a run with its experts, its evaluations by episodes and its processes.

    Attributes:
        preset: tuned: the setting that works; paper: the paper's letter; smoke: ends within a
            minute. Under tuned a task brings settings of its own, where it has some.
        grid: main: one number of demonstrations; full: the paper's sweep over N_T, which makes
            Figures 4 and 5, and under tuned 20,000 steps for each learner.
        out: Folder of the results; default results/PRESET, or results/PRESET-full.
        evaluate_every_episodes: Also evaluate each learner whenever it has lived this many more
            episodes (the paper: 100).
        evaluation_starts_episodes: Start states of the evaluations by episodes.
        expert: Who demonstrates: each learner has an expert of its own (they share where there are
            fewer), or all share the best one that solved the task, the median one, or all of them
            alike.
        experts: How they are made.
        distributed: Share the run with the other processes of the cluster that JAX detects
            (docs/scaling.md).
        coordinator: Share the run with other processes: HOST:PORT of process 0, the same for all of
            them.
        processes: With coordinator: how many processes there are.
        process_id: With coordinator: which of them this is, from 0; process 0 alone writes results.
    """

    preset: Literal["tuned", "paper", "smoke"] = "tuned"
    grid: Literal["main", "full"] = "main"
    evaluate_every_episodes: Size | None = None
    evaluation_starts_episodes: Size = 100
    expert: Expert = "each"
    experts: ExpertSettings = ExpertSettings()
    distributed: bool = False
    coordinator: str | None = None
    processes: Size | None = None
    process_id: Count | None = None

    @property
    def resolved_experts(self) -> Experts:
        """Who demonstrates; the defaults depend on whether each learner has its own expert."""
        each = self.expert == "each"
        return Experts(
            self.expert,
            self.experts.seeds or (self.seeds if each else 16),
            self.experts.steps,
            self.experts.trajectories or max(200 if each else 1_024, *self.n_demos),
            self.experts.settings or self.settings,
        )

    @property
    def folder(self) -> Path:
        """Where the results go."""
        name = self.preset if self.grid == "main" else f"{self.preset}-{self.grid}"
        out = self.out if self.out is not None else Path("results") / name
        # Normalised: making a/../b would also make a.
        return Path(os.path.normpath(out))

    @property
    def cluster(self) -> ClusterOptions:
        """Which processes share the run."""
        return ClusterOptions(self.distributed, self.coordinator, self.processes, self.process_id)


def of_task(env: str) -> StudyConfig:
    """The configuration of a task: its settings and budget, see `training.tasks`.

    A task without settings of its own has the car's; its experts train as its learners do.
    """
    found = tasks.found(env)
    task = found or tasks.TaskSettings()
    experts = ExpertSettings(steps=task.expert_steps, settings=task.experts if found else None)
    return StudyConfig(env=env, max_steps=task.steps, experts=experts, settings=task.settings)
