"""A cell whose method never acts: maximum-entropy IRL on a grid of the task, all seeds."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax.agents.hot_start import HotStartData
from cmedirl_jax.data import demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs.cells import evaluator as evaluator_lib
from cmedirl_jax.runs.cells import pools
from cmedirl_jax.runs.cells.cell import CellResult
from cmedirl_jax.runs.cells.evaluator import Evaluator
from cmedirl_jax.runs.cells.record import EpisodeRows, EvaluationRows, Means
from cmedirl_jax.runs.cluster.base import ALONE
from cmedirl_jax.runs.storage.checkpoints import Checkpointer
from cmedirl_jax.tabular import discretise, imitation
from cmedirl_jax.tabular.discretise import FiniteMDP
from cmedirl_jax.training import initialise, seeds
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.methods import Method
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import DemonstrationSubset


class Fitted(NamedTuple):
    """What each seed learned.

    Attributes:
        reward: `[S, A]`.
        log_probabilities: `[S, A]`, of its soft-optimal policy.
        demonstration_steps: `[]` int32, environment steps in the seed's own demonstrations.
    """

    reward: Any
    log_probabilities: Any
    demonstration_steps: Any


class CompiledFit(NamedTuple):
    """The compiled functions of a method.

    Attributes:
        fit: `(keys [slots], episodes [slots, E], mdp, data, n_demonstrations) -> Fitted`
            `[slots, ...]`.
        mdp: the environment on the grid.
        evaluator: of greedy policies, by tables of preferences `[seeds, S, A]`.
        soft_evaluator: of the soft policies, by tables of log-probabilities `[seeds, S, A]`.
        devices: how many share the seeds.
    """

    fit: Callable[..., Fitted]
    mdp: FiniteMDP
    evaluator: Evaluator
    soft_evaluator: Evaluator
    devices: int


def compile_method(
    env: Env | HostEnv,
    method: Method,
    settings: Settings,
    *,
    devices: Sequence[Any],
    subset_size: int | None,
    gather: Callable[[Any], Any] = ALONE.gather,
) -> CompiledFit:
    """Jit a method's fit and its evaluators. Compiles at first use."""
    kind = method.tabular
    assert kind is not None
    assert isinstance(env, Env)
    mdp = jax.jit(lambda: imitation.discretised(env, settings.tabular))()

    def of_seed(
        seed: tuple[jax.Array, DemonstrationSubset],
        mdp: FiniteMDP,
        data: HotStartData,
        n_demonstrations: int,
    ):
        # The keys of the methods that act, so that a seed has the same demonstrations in each.
        key, episodes = seed
        keys, _ = initialise.split(key)
        subset = demonstrations.subset(keys.subset, episodes, n_demonstrations, subset_size)
        fitted = imitation.fit(
            keys.reward,
            mdp,
            env.spec,
            data._replace(episodes=episodes),
            subset,
            kind=kind,
            settings=settings.tabular,
        )
        steps = jnp.sum(subset.length)
        return Fitted(fitted.reward, fitted.policy.log_probabilities, steps)

    # One seed at a time on each device: the fixed points of seeds take unequal iterations.
    fit = seeds.map_devices(seeds.map_groups(of_seed, 1), devices)

    def greedy(table: jax.Array, observation: jax.Array) -> jax.Array:
        return discretise.greedy(mdp, table)(observation)

    def soft(table: jax.Array, observation: jax.Array) -> jax.Array:
        return discretise.look_up(mdp, table, observation)

    return CompiledFit(
        fit=jax.jit(lambda keys, episodes, *shared: fit((keys, episodes), *shared)),
        mdp=mdp,
        evaluator=evaluator_lib.make(env, greedy, 1, devices, gather),
        soft_evaluator=evaluator_lib.make(discretise.sampled(mdp, env), soft, 1, devices, gather),
        devices=len(devices),
    )


def train(
    programs: CompiledFit,
    key: jax.Array,
    data: HotStartData,
    n_demos: int,
    *,
    seeds_count: int,
    first_seed: int = 0,
    evaluation_starts: int,
    checkpointer: Checkpointer | None = None,
) -> CellResult:
    """Fit every seed; evaluate its greedy policy once, and its soft one as protocol "soft".

    Args:
        programs: of the cell's method.
        key: the cell's randomness.
        data: the demonstrations, with `episodes` `[learners, E]`: those that each learner of the
            study draws from.
        n_demos: how many of them each seed draws.
        seeds_count: how many seeds.
        first_seed: the number of the first of them in the study.
        evaluation_starts: start states of the evaluations.
        checkpointer: saves the seeds that are fitted, and loads those that were saved before.

    Raises:
        Interrupted: by the checkpointer.
    """
    # A seed takes seconds: the host looks for signals after one seed of each device.
    keys = seeds.keys(key, first_seed + seeds_count + programs.devices)[first_seed:]
    episodes = pools.episodes_of(data, first_seed + np.arange(len(keys)))
    parts: list[Fitted] = []

    def fit(first: int) -> Fitted:
        now = slice(first, first + programs.devices)
        mine = jax.tree.map(lambda leaf: leaf[now], episodes)
        return programs.fit(keys[now], mine, programs.mdp, data, n_demos)

    def abstract(record: dict[str, np.ndarray]) -> Fitted:
        one = jax.eval_shape(lambda: fit(0))
        return jax.tree.map(
            lambda leaf: jax.ShapeDtypeStruct((int(record["fitted"]), *leaf.shape[1:]), leaf.dtype),
            one,
        )

    def take() -> tuple[Fitted, dict[str, np.ndarray]]:
        fitted = _joined(parts)
        return fitted, {"fitted": np.array(len(fitted.reward))}

    # Continue, fit the seeds that are left, and save.
    fitted = 0
    if checkpointer is not None and (saved := checkpointer.load(abstract)) is not None:
        fitted = saved.step
        parts.append(saved.state)
    for first in range(fitted, seeds_count, programs.devices):
        parts.append(programs.evaluator.gather(fit(first)))
        if checkpointer is not None:
            checkpointer.save_if_due(first + programs.devices, take)
    return _result(
        programs,
        jax.tree.map(lambda leaf: leaf[:seeds_count], _joined(parts)),
        evaluation_starts,
    )


def _result(programs: CompiledFit, fitted: Fitted, evaluation_starts: int) -> CellResult:
    """Evaluate the fitted seeds, leaves `[seeds, ...]`."""
    table = fitted.log_probabilities
    seeds_count = len(table)
    zeros, nothing = np.zeros(seeds_count, np.int32), np.zeros(0, np.int32)
    unknown = Means(*(np.full(seeds_count, np.nan) for _ in Means._fields))

    def rows(protocol: str, evaluation: Evaluation) -> EvaluationRows:
        every = np.arange(seeds_count)
        return EvaluationRows(protocol, every, zeros, zeros, evaluation, unknown)

    greedy, soft = (
        evaluator.summarise(evaluator.on_starts(table, evaluation_starts))
        for evaluator in (programs.evaluator, programs.soft_evaluator)
    )
    return CellResult(
        evaluations=[rows("steps", greedy), rows("soft", soft)],
        episodes=EpisodeRows(*(nothing for _ in EpisodeRows._fields)),
        best=table,
        reward=fitted.reward,
        env_steps=zeros,
        demonstration_steps=fitted.demonstration_steps,
        diverged=~np.isfinite(fitted.reward).all(axis=(1, 2)),
        final=table,
    )


def _joined(parts: list[Fitted]) -> Fitted:
    return jax.tree.map(lambda *leaves: np.concatenate(leaves), *parts)
