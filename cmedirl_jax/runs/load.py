"""A run's policies and rewards as plain functions.

act = load_policy("results/tuned", "hs-me-ddpg", seed=3)
action = act(observation)
r_d = load_reward("results/tuned", "hs-me-ddpg", seed=3)
value = r_d(observation, action)
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from cmedirl_jax import envs, networks
from cmedirl_jax.io import checkpoint
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import cells
from cmedirl_jax.runs.storage.cells import SavedCell
from cmedirl_jax.tabular import discretise, imitation, table_reward
from cmedirl_jax.training import compose
from cmedirl_jax.training.methods import METHODS, Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import EnvSpec


class Functions(NamedTuple):
    """One function with parameters for each seed of a cell.

    Attributes:
        function: `(params of one seed, *arguments)`.
        params: leaves `[seeds, ...]`.
    """

    function: Callable[..., jax.Array]
    params: Any

    def of(self, index: int) -> Callable[..., jax.Array]:
        """The function of one seed, which converts its arguments to arrays."""
        params = jax.tree.map(lambda leaf: jnp.asarray(leaf[index]), self.params)
        return lambda *arguments: self.function(params, *map(jnp.asarray, arguments))


class LearnedCell(NamedTuple):
    """What a cell has learned, with the task, method and settings that it learned with."""

    cell: SavedCell
    task: EnvSpec
    method: Method
    settings: Settings

    @property
    def only_tables(self) -> bool:
        """Whether the method has no networks: its policies and rewards are tables on a grid."""
        return self.method.tabular is not None and not self.method.interacts

    @property
    def has_rewards(self) -> bool:
        """Whether the method has a reward of its own."""
        return (self.cell.path / "rewards").exists()

    def policies(self) -> Functions:
        """Each seed's best policy, `(actor, observation [..., O]) -> action [..., A]`."""
        if self.only_tables:
            env = envs.make(self.task.id)
            # Only the grids of the discretised task are needed, which no computation gives.
            mdp = jax.eval_shape(lambda: imitation.discretised(env, self.settings.tabular))
            return Functions(
                lambda table, observation: discretise.greedy(mdp, table)(observation),
                self._saved("policies", mdp.reward),
            )
        made = networks.make(self.task, self.settings.architecture)
        return Functions(
            lambda actor, observation: networks.policy(made, actor, observation),
            self._saved("policies", _abstract(made.actor.init)),
        )

    def rewards(self) -> Functions:
        """Each seed's last reward, `(params, observation [..., O], action [..., A]) -> [...]`.

        Raises:
            ValueError: if the method has no reward of its own.
        """
        if not self.has_rewards:
            raise ValueError(f"{self.method.name} learns no reward")
        if self.only_tables:
            states, actions = imitation.grids(self.task, self.settings.tabular)
            learner = table_reward.make(states, actions, self.settings.reward)
            # The last row is the absorbing state's, which no observation is in.
            whole = jax.ShapeDtypeStruct((states.size + 1, actions.size), jnp.float32)
            params = self._saved("rewards", whole)[:, :-1]
        else:
            steps = self.task.max_episode_steps
            made = compose.compose(self.task, self.method, self.settings, steps)
            assert made.learner is not None
            learner = made.learner
            params = self._saved("rewards", _abstract(learner.init).params)
        state = jax.jit(learner.init)(jax.random.key(0))
        return Functions(
            lambda params, observation, action: learner.reward(
                state.replace(params=params), observation, action
            ),
            params,
        )

    def _saved(self, name: str, one: Any) -> Any:
        """The parameters `[seeds, ...]` of a folder; `one` has one seed's structure and shapes."""

        def of_cell(leaf: Any) -> jax.ShapeDtypeStruct:
            return jax.ShapeDtypeStruct((self.cell.key.seeds, *leaf.shape), leaf.dtype)

        return checkpoint.load(self.cell.path / name, jax.tree.map(of_cell, one))


def load_policy(
    run: str | Path, method: str, seed: int, n_demos: int | None = None, study: int | None = None
) -> Callable[[Any], jax.Array]:
    """A seed's best policy, without exploration noise.

    Args:
        run: the run's folder.
        method: the method's name.
        seed: which learner.
        n_demos: demonstrations of the learner, where the run has several numbers of them.
        study: the study's seed, where the run has several.

    Returns:
        `observation [..., O] -> action [..., A]`, not compiled.

    Raises:
        ValueError: if the run has no such cell or several, saying which there are; or if a file is
            damaged or of another version.
        OSError: if a file cannot be read.
    """
    learned = learned_cell(run, method, seed, n_demos, study)
    return learned.policies().of(seed - learned.cell.key.first_seed)


def load_reward(
    run: str | Path, method: str, seed: int, n_demos: int | None = None, study: int | None = None
) -> Callable[[Any, Any], jax.Array]:
    """A seed's reward r_D at the end of its training: bounded, and with its gauge's offset.

    The reward of `maxent-irl` and `deep-maxent-irl` is interpolated on their grid.

    Args:
        run: the run's folder.
        method: the method's name.
        seed: which learner.
        n_demos: demonstrations of the learner, where the run has several numbers of them.
        study: the study's seed, where the run has several.

    Returns:
        `(observation [..., O], action [..., A]) -> [...]`, not compiled.

    Raises:
        ValueError: as `load_policy`; and if the method has no reward of its own.
        OSError: if a file cannot be read.
    """
    learned = learned_cell(run, method, seed, n_demos, study)
    try:
        rewards = learned.rewards()
    except ValueError as error:
        raise ValueError(f"{run}: {error}") from error
    return rewards.of(seed - learned.cell.key.first_seed)


def _abstract(init: Callable[[jax.Array], Any]) -> Any:
    """The structure and shapes of the parameters that `init` draws."""
    return jax.eval_shape(lambda: init(jax.random.key(0)))


def learned_cell(
    run: str | Path, method: str, seed: int, n_demos: int | None = None, study: int | None = None
) -> LearnedCell:
    """What the cell of a learner has learned; `load_policy` describes the arguments and errors."""
    finished = _finished(run)

    def matches(cell: SavedCell) -> bool:
        key = cell.key
        return (
            key.method == method
            and seed in key.seed_range
            and n_demos in (None, key.n_demos)
            and study in (None, key.study)
        )

    matching = [cell for cell in finished if matches(cell)]
    if not matching:
        there = "; ".join(str(cell.key) for cell in finished)
        asked = _words(method=method, seed=seed, n_demos=n_demos, study=study)
        raise ValueError(f"{run}: holds no {asked}; there are: {there}")
    if len(matching) > 1:
        choices = "; ".join(
            _words(n_demos=cell.key.n_demos, study=cell.key.study) for cell in matching
        )
        raise ValueError(f"{run}: holds several of {method}, seed {seed}; give one of: {choices}")
    return _learned(matching[0])


def learned_cells(run: str | Path) -> list[LearnedCell]:
    """What each finished cell of a run has learned.

    Raises:
        ValueError: if there is none, or a file is damaged or of another version.
    """
    return [_learned(cell) for cell in _finished(run)]


def _finished(run: str | Path) -> list[SavedCell]:
    try:
        finished = cells.finished(Path(run))
    except UserError as error:
        raise ValueError(str(error)) from error
    if not finished:
        raise ValueError(
            f"{run}: holds no finished cell of a run; a run that was stopped goes on by the same "
            "command"
        )
    return finished


def _learned(cell: SavedCell) -> LearnedCell:
    try:
        return LearnedCell(cell, cell.task(), METHODS[cell.key.method], cell.settings())
    except (LookupError, ValueError, TypeError) as error:
        raise ValueError(f"{cell.path}: {error}") from error


def _words(**values: Any) -> str:
    return ", ".join(f"{name} {value}" for name, value in values.items() if value is not None)
