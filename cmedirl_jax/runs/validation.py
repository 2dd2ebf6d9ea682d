"""From a configuration to a plan: everything that can be refused is refused before any work."""

import dataclasses
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import envs, networks, ranges
from cmedirl_jax.agents.exploration import ExplorationSettings
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs import demonstrations as given
from cmedirl_jax.runs.cells import pools
from cmedirl_jax.runs.cells.pools import LearnersPool
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.cluster.base import ALONE, Cluster
from cmedirl_jax.runs.config import Experts, StudyConfig
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.loggers import registry
from cmedirl_jax.runs.storage import cells, plain
from cmedirl_jax.tabular import imitation
from cmedirl_jax.training import compose
from cmedirl_jax.training.compose import Algorithm
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import EnvSpec


class Plan(NamedTuple):
    """The work of a run, from a configuration that has been checked.

    Attributes:
        folder: where its results go.
        config: the configuration as JSON values, for config.json.
        env: the task.
        study: the study's seed.
        asked: method and number of demonstrations of each cell.
        seeds: how many learners of each.
        seeds_at_once: of these, how many train together; None: all.
        budget: how long they train, and when they are evaluated.
        settings: every other choice of theirs.
        subset_size: the largest number of demonstrations of a learner.
        group: seeds that a device steps together; None: what is fastest.
        checkpoint_every: seconds from one checkpoint to the next.
        log: the loggers' names.
        log_seeds: whether they log each seed too.
        demos: the demonstrations that the user gave, or None.
        experts: who demonstrates if none were given.
    """

    folder: Path
    config: dict[str, Any]
    env: Env | HostEnv
    study: int
    asked: list[tuple[str, int]]
    seeds: int
    seeds_at_once: int | None
    budget: Budget
    settings: Settings
    subset_size: int
    group: int | None
    checkpoint_every: float
    log: tuple[str, ...]
    log_seeds: bool
    demos: Demonstrations | None
    experts: Experts

    @property
    def together(self) -> int:
        """How many learners of a cell train together; the others follow in blocks."""
        return min(self.seeds_at_once or self.seeds, self.seeds)

    @property
    def capacity(self) -> int:
        """Transitions in a learner's replay, and in an expert's: they share a program."""
        steps = self.budget.max_steps
        return steps if self.demos is not None else max(steps, self.experts.steps)

    def of_learners(self, pool: Demonstrations) -> LearnersPool:
        """Share a pool among the run's learners.

        Raises:
            UserError: if it holds too few demonstrations, or does not say whose they are.
        """
        agent = self.settings.agent
        try:
            shared = pools.of_learners(pool, self.seeds, agent.discount, agent.reward_scale)
        except ValueError as error:
            raise UserError(
                f"--out: {self.folder / 'demonstrations'}: {error}; give another folder"
            ) from error
        given.check_enough(self.asked, shared.data.episodes.start.shape[1])
        return shared


def plan(config: StudyConfig, cluster: Cluster = ALONE, *, fewer_will_do: bool = False) -> Plan:
    """Check a configuration and work it out; reads the demonstrations that it names.

    Args:
        config: what the user asks for.
        cluster: the processes that share the run; process 0 alone reads files.
        fewer_will_do: `n_demos` is a default; a file that holds fewer demonstrations is used whole.

    Raises:
        UserError: naming the option, what is wrong and what would be right.
    """
    env = check(config)
    path, demos = config.demos, None
    if path is not None:
        demos = cluster.pool_from_writer(
            lambda: given.load(
                path, env, config.check_demos, config.demos_format, config.demos_actions
            )
        )
        assert demos is not None
        given.check_needs(config, demos)
        held = given.held(path, demos)
        if fewer_will_do and held < max(config.n_demos):
            config = dataclasses.replace(config, n_demos=(held,))
        given.check_enough(cells.asked(config.methods, config.n_demos), held)
    return Plan(
        folder=config.folder,
        config=cluster.from_writer(lambda: describe(config, demos)),
        env=env,
        study=config.seed,
        asked=cells.asked(config.methods, config.n_demos),
        seeds=config.seeds,
        seeds_at_once=config.seeds_at_once,
        budget=budget_of(config, env),
        settings=config.settings,
        subset_size=max(config.n_demos),
        group=config.group,
        checkpoint_every=config.checkpoint_every,
        log=config.log,
        log_seeds=config.log_seeds,
        demos=demos,
        experts=config.resolved_experts,
    )


def describe(config: StudyConfig, demos: Demonstrations | None = None) -> dict[str, Any]:
    """The fully resolved configuration as JSON values; `demos` are those that it names."""
    described = plain.plain(config)
    if config.demos is None:
        return described
    # Another file under the same name is another configuration.
    if (digest := given.digest(config.demos, demos)) is not None:
        described["demos_sha256"] = digest
    return described


def budget_of(config: StudyConfig, env: Env | HostEnv) -> Budget:
    """How long each learner trains."""
    most = [config.max_steps]
    if config.max_episodes is not None:
        most.append(config.max_episodes * env.spec.max_episode_steps)
    return Budget(
        max_steps=min(steps for steps in most if steps is not None),
        max_episodes=config.max_episodes,
        evaluate_every=config.evaluate_every,
        evaluation_starts=config.evaluation_starts,
        evaluate_every_episodes=config.evaluate_every_episodes,
        evaluation_starts_episodes=config.evaluation_starts_episodes,
    )


def check(config: StudyConfig) -> Env | HostEnv:
    """Refuse what can be refused before any work; the task.

    Raises:
        UserError: naming the option, what is wrong and what would be right.
    """
    # Names, and lists of them.
    for method in config.methods:
        if method not in METHODS:
            raise UserError(f"--methods: unknown method {method!r}; there are {', '.join(METHODS)}")
    _check_log(config)
    try:
        env = envs.find(config.env, asynchronous=config.asynchronous)
        if isinstance(env, Env):
            envs.check(env, steps=0)
    except (TypeError, ValueError) as error:
        raise UserError(f"--env: {' '.join(str(error).split())}") from error
    _check_host(config, isinstance(env, HostEnv))
    for name in ("methods", "n_demos"):
        values = getattr(config, name)
        if not values or len(set(values)) < len(values):
            raise UserError(f"--{name.replace('_', '-')}: give one or more, each once")
    if config.demos is not None and not str(config.demos).isprintable():
        raise UserError(f"--demos: {str(config.demos)!r} cannot be printed; give a plainer name")
    # Numbers.
    if config.max_steps is None and config.max_episodes is None:
        raise UserError("--max-steps: give a number, or give --max-episodes")
    _check_ranges(config)
    _check_epsilon(config.settings.exploration)
    capacity = budget_of(config, env).max_steps
    if capacity >= 2**31:
        raise UserError(f"--max-episodes: makes {capacity} steps, more than 2^31 - 1")
    # Parts that must fit the task and each other.
    _check_parts(config, env, capacity)
    if config.demos is None:
        asked = cells.asked(config.methods, config.n_demos)
        given.check_enough(asked, config.resolved_experts.trajectories)
    return env


def _check_log(config: StudyConfig) -> None:
    """Refuse loggers that are not there, or say nothing."""
    try:
        registry.check(config.log)
    except ValueError as error:
        raise UserError(f"--log: {error}") from error
    if len(set(config.log)) < len(config.log):
        raise UserError("--log: give each once")
    if config.log_seeds and not config.log:
        raise UserError("--log-seeds: there is no --log")


def _check_host(config: StudyConfig, on_host: bool) -> None:
    """Refuse options that say nothing to the task's kind."""
    if on_host and config.cluster.several:
        raise UserError(f"--processes: {config.env} is stepped on one host, by one process")
    if on_host and config.group is not None:
        raise UserError(f"--group: {config.env} is stepped on the host, all seeds together")
    if config.asynchronous and not on_host:
        raise UserError(f"--asynchronous: {config.env} is a task in JAX")


def _check_parts(config: StudyConfig, env: Env | HostEnv, capacity: int) -> None:
    try:
        networks.make(env.spec, config.settings.architecture)
    except ValueError as error:
        raise UserError(f"--architecture: {error}") from error
    tabular = config.settings.tabular
    of_grids = [name for name in config.methods if METHODS[name].tabular]
    if of_grids and isinstance(env, HostEnv):
        raise UserError(f"--methods {of_grids[0]}: it needs a task in JAX, {config.env} is not")
    if of_grids and isinstance(env, Env):
        try:
            jax.eval_shape(lambda: imitation.discretised(env, tabular))
            for name in config.methods:
                if kind := METHODS[name].tabular:
                    imitation.check(env.spec, kind, tabular)
        except ValueError as error:
            raise UserError(f"--tabular: {error}") from error
    for name in config.methods:
        try:
            parts = compose.compose(env.spec, METHODS[name], config.settings, capacity)
            _check_reward_batch(env.spec, parts)
        except ValueError as error:
            raise UserError(f"--methods {name}: {error}") from error


def _check_reward_batch(spec: EnvSpec, parts: Algorithm) -> None:
    """Trace the reward of all pairs of an update, whose features may be too many."""
    learner, sampler = parts.learner, parts.sampler
    if learner is None or sampler is None:
        return
    pairs = 2 * sampler.batch_size * (1 if sampler.shares_pairs else spec.max_episode_steps)
    observation, action = (
        jax.ShapeDtypeStruct((pairs, dim), jnp.float32)
        for dim in (spec.observation_dim, spec.action_dim)
    )
    jax.eval_shape(
        lambda *pair: learner.reward(learner.init(jax.random.key(0)), *pair), observation, action
    )


def _check_ranges(config: StudyConfig) -> None:
    """Refuse a number out of its range.

    Raises:
        UserError: naming the option, what it must be and what it is.
    """
    for name, wrong in ranges.out_of_range(config):
        option = name.removeprefix("settings.").replace("_", "-")
        raise UserError(f"--{option}: {wrong}")


def _check_epsilon(settings: ExplorationSettings) -> None:
    factor, epsilon = settings.hot_start_factor, settings.epsilon_greedy
    largest = factor * max(epsilon.epsilon_start, epsilon.epsilon_end)
    if settings.kind == "epsilon-greedy" and largest > 1.0:
        raise UserError(f"--exploration.hot-start-factor: makes epsilon {largest:g}, above 1")
