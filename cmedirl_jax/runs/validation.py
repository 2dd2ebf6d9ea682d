"""What a run will do, and whether it can: cells, budget, and every refusal before any work."""

from typing import NamedTuple

import jax

from cmedirl_jax import envs, networks, ranges
from cmedirl_jax.agents.exploration import ExplorationSettings
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env
from cmedirl_jax.irl import rewards
from cmedirl_jax.runs.cells.record import Budget
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.tabular import imitation
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS, Method


class Cell(NamedTuple):
    """A method and its number of demonstrations; 0 for a method that uses none."""

    method: Method
    n_demos: int

    @property
    def name(self) -> str:
        """The cell's name in paths and progress."""
        return f"{self.method.name}-n{self.n_demos}" if self.n_demos else self.method.name


def cells_of(config: StudyConfig) -> list[Cell]:
    """The grid's cells; a method without demonstrations has one."""
    return [
        Cell(METHODS[name], n_demos)
        for name in config.methods
        for n_demos in (config.n_demos if METHODS[name].uses_demonstrations else (0,))
    ]


def budget_of(config: StudyConfig, env: Env) -> Budget:
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


def check(config: StudyConfig) -> None:
    """Refuse what can be refused before any work.

    Raises:
        UserError: naming the option, what is wrong and what would be right.
    """
    for method in config.methods:
        if method not in METHODS:
            raise UserError(f"--methods: unknown method {method!r}; there are {', '.join(METHODS)}")
    try:
        env = envs.make(config.env)
    except ValueError as error:
        raise UserError(f"--env: {error}") from error
    for name in ("methods", "n_demos"):
        values = getattr(config, name)
        if not values or len(set(values)) < len(values):
            raise UserError(f"--{name.replace('_', '-')}: give one or more, each once")
    if config.demos is not None and not str(config.demos).isprintable():
        raise UserError(f"--demos: {str(config.demos)!r} cannot be printed; give a plainer name")
    if config.max_steps is None and config.max_episodes is None:
        raise UserError("--max-steps: give a number, or give --max-episodes")
    _check_ranges(config)
    _check_epsilon(config.settings.exploration)
    try:
        networks.make(env.spec, config.settings.architecture)
    except ValueError as error:
        raise UserError(f"--architecture: {error}") from error
    if any(METHODS[name].tabular for name in config.methods):
        try:
            jax.eval_shape(lambda: imitation.discretised(env, config.settings.tabular))
            rewards.radial_basis(env.spec, config.settings.tabular.centres)
        except ValueError as error:
            raise UserError(f"--tabular: {error}") from error
    capacity = budget_of(config, env).max_steps
    if capacity >= 2**31:
        raise UserError(f"--max-episodes: makes {capacity} steps, more than 2^31 - 1")
    for name in config.methods:
        try:
            compose.compose(env.spec, METHODS[name], config.settings, capacity)
        except ValueError as error:
            raise UserError(f"--methods {name}: {error}") from error
    if config.demos is None:
        check_enough(config, config.experts.trajectories)


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


def load_demonstrations(config: StudyConfig, env: Env) -> Demonstrations:
    """The file that `--demos` names.

    Raises:
        UserError: if it is missing, damaged, foreign, or holds too few.
    """
    assert config.demos is not None
    try:
        pool = demonstrations.load(config.demos, env.spec)
    except FileNotFoundError as error:
        raise UserError(
            f"--demos: there is no file {config.demos}; give one that demonstrations.save wrote"
        ) from error
    except OSError as error:
        raise UserError(f"--demos: {config.demos}: {error.strerror}") from error
    except ValueError as error:
        raise UserError(f"--demos: {error}") from error
    # The tables have a column of each.
    expert = pool.metadata.get("expert", "")
    if not isinstance(expert, str):
        raise UserError(f"--demos: {config.demos}: expert in its metadata is {expert!r}, no text")
    steps = pool.metadata.get("expert_env_steps", 0)
    if type(steps) is not int or not 0 <= steps < 2**63:
        raise UserError(
            f"--demos: {config.demos}: expert_env_steps in its metadata is {steps!r}, no count"
        )
    check_enough(config, int(pool.episode[-1]) + 1)
    return pool


def check_enough(config: StudyConfig, held: int) -> None:
    """Refuse to draw more demonstrations than the pool holds.

    Raises:
        UserError: saying how many there are.
    """
    asked = max(cell.n_demos for cell in cells_of(config))
    if asked > held:
        raise UserError(f"--n-demos: {asked} asked, the pool holds {held}")
