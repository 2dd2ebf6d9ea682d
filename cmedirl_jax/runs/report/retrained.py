"""Fresh agents on a run's rewards alone, beside agents on r_e and on rewards that know nothing."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl

from cmedirl_jax import compilation
from cmedirl_jax.assess import retraining
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.irl import controls
from cmedirl_jax.runs.drawing import Figure
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report import curves
from cmedirl_jax.runs.report.reward_samples import LEARNER, Context, RewardedRun, with_experts
from cmedirl_jax.training import seeds as seeds_lib
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.settings import Settings
from cmedirl_jax.types import Transition

EVALUATIONS = 8
"""Evaluations of an agent, apart from the first."""
AT_THE_END = 2
"""Of these, the last ones whose mean is an agent's return."""
AGENTS, NETWORKS = 2**31, 2**31 + 1
"""What the run's key is folded with for agents and random networks: no seed's number."""
OWN = "own"
"""The physics that the rewards were learned under."""
TRUE = "r_e"
MEASURES = {
    "return": "return of r_e, mean of the last quarter of the evaluations",
    "goal": "share of episodes that the task ended, likewise",
    "regret": "return of an agent on r_e with the same networks and starts, less this one's",
}
"""What is measured, in words."""


class Retraining(NamedTuple):
    """What to retrain.

    Attributes:
        env: the task.
        steps: environment steps of each agent.
        physics: parameters of the environment by name, `OWN` first.
        devices: that share the agents.
    """

    env: Env
    steps: int
    physics: Mapping[str, Any]
    devices: Sequence[Any]


def plan(
    env: Env | HostEnv, steps: int, changes: Sequence[str], devices: Sequence[Any]
) -> Retraining:
    """Check what a user asks for.

    Args:
        env: the task.
        steps: environment steps of each agent.
        changes: of the environment's parameters, as "power=0.0012" or "a=1,b=2".
        devices: that share the agents.

    Raises:
        UserError: for a task that is not in JAX, a number of steps that is no multiple of the
            evaluations, or a change that the task does not know.
    """
    if not isinstance(env, Env):
        raise UserError(f"--retrain: {env.spec.id} is no task in JAX")
    if steps % EVALUATIONS:
        raise UserError(f"--retrain: {steps} is no multiple of {EVALUATIONS}, the evaluations")
    own = env.default_params
    return Retraining(
        env, steps, {OWN: own} | {name: _changed(own, name) for name in changes}, devices
    )


def _changed(params: Any, change: str) -> Any:
    """Parameters with other numbers in some of their fields."""
    is_dataclass = dataclasses.is_dataclass(params)
    fields = [field.name for field in dataclasses.fields(params)] if is_dataclass else []
    names = fields or list(getattr(params, "_fields", ()))
    numbers: dict[str, Any] = {}
    for part in change.split(","):
        name, _, text = part.partition("=")
        if name not in names:
            there = ", ".join(names) or "none"
            raise UserError(f"--physics: {part} names none of the task's parameters: {there}")
        own = np.asarray(getattr(params, name))
        if own.ndim or own.dtype.kind not in "iuf":
            raise UserError(f"--physics: {name} is no single number, and can be changed in Python")
        try:
            numbers[name] = own.dtype.type(text).item()
        except (OverflowError, ValueError):
            raise UserError(f"--physics: {part} gives no number as {own.item()} is") from None
        if not np.isfinite(numbers[name]):
            raise UserError(f"--physics: {part} is not finite")
    return dataclasses.replace(params, **numbers) if fields else params._replace(**numbers)


class _Frozen(NamedTuple):
    """Rewards that agents learn from.

    Attributes:
        method: their name.
        n_demos: demonstrations that each was learned from.
        seeds: `[R]`, of the agents.
        rewards: `R` of them.
        size: `[R]`, root mean square of what each pays for the steps that were visited.
    """

    method: str
    n_demos: int
    seeds: np.ndarray
    rewards: Rewards
    size: np.ndarray


def of_run(
    run: RewardedRun, plan: Retraining, say: Callable[[str], None]
) -> Iterator[pl.DataFrame]:
    """Train agents on r_e, on random networks and constants, and on each learned reward in turn.

    All but r_e are scaled to one root mean square over the steps that demonstrations and policies
    visit, the median over methods of what was learned: an agent depends on a reward's scale, and an
    optimum does not.

    Args:
        run: the rewards.
        plan: what to retrain.
        say: called with a line about each reward before its agents train.

    Yields:
        A row for each evaluation of each agent of a reward: method, n_demos, seed, physics, step,
        return and goals.
    """
    learned = [
        _Frozen(
            each.method.name,
            each.n_demos,
            each.seeds,
            each.rewards,
            _size(each.rewards, each.visited),
        )
        for each in run.learners
    ]
    size = float(np.median([each.size.mean() for each in learned]))
    sizes = ", ".join(f"{each.size.mean():.2g} {each.method}" for each in learned)
    say(f"Root mean squares as learned: {sizes}; as paid: {size:.2g}")
    settings, programs = run.learners[0].settings, {}

    def train(method: str, n_demos: int, seeds: np.ndarray, pay: Any, params: Any) -> pl.DataFrame:
        say(f"{method}: {len(seeds)} fresh agents, each under {len(plan.physics)} physics")
        program = programs.setdefault(pay, _program(plan, settings, pay))
        labels = (pl.lit(method).alias("method"), pl.lit(n_demos).alias("n_demos"))
        return _rows(run.context, plan, program, params, seeds).select(*labels, pl.all())

    yield train(TRUE, 0, np.arange(run.context.seeds), None, ())
    for method, n_demos, seeds, rewards, own in [*_controls(run), *learned]:
        # What pays nothing anywhere stays as it is.
        scales = np.divide(size, own, out=np.ones_like(own), where=own > 0).astype(np.float32)
        yield train(method, n_demos, seeds, rewards.reward, (scales, rewards.params))


def _controls(run: RewardedRun) -> list[_Frozen]:
    """The rewards that the learned ones are compared with, apart from r_e."""
    count = run.context.seeds
    every, ones = np.arange(count), np.ones(count)
    learner = controls.random(run.context.env.spec)
    key = jax.random.fold_in(run.context.key, NETWORKS)
    networks = Rewards(learner.reward, jax.vmap(learner.init)(seeds_lib.keys(key, count)))
    # A learner may be left out, so that there are fewer of them than seeds.
    first = run.learners[0]
    steps = jax.tree.map(lambda leaf: leaf[every % len(first.seeds)], first.visited)

    def constant(params: jax.Array, observation: jax.Array, action: jax.Array) -> jax.Array:
        del action
        return jnp.broadcast_to(params, observation.shape[:-1])

    return [
        _Frozen("random", 0, every, networks, _size(networks, steps)),
        _Frozen("+constant", 0, every, Rewards(constant, np.float32(ones)), ones),
        _Frozen("-constant", 0, every, Rewards(constant, np.float32(-ones)), ones),
    ]


def _size(rewards: Rewards, steps: Transition) -> np.ndarray:
    """`[R]`, root mean square of what each reward pays for its steps, leaves `[R, N, ...]`."""
    pay = jax.jit(jax.vmap(rewards.reward))
    paid = np.asarray(pay(rewards.params, steps.observation, steps.action), np.float64)
    return np.sqrt(np.square(paid).mean(axis=1))


def _program(
    plan: Retraining, settings: Settings, pay: Callable[..., jax.Array] | None
) -> Callable[..., Evaluation]:
    """Trains agents on rewards of one function: `((keys, (scale, params))) -> Evaluation`."""
    physics = jax.tree.map(lambda *leaves: np.stack(leaves), *plan.physics.values())

    def scaled(params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        assert pay is not None
        scale, own = params
        return scale * pay(own, observation, action)

    def train(agents: tuple[jax.Array, Any]) -> Evaluation:
        keys, params = agents
        return retraining.retrain(
            keys,
            plan.env,
            None if pay is None else Rewards(scaled, params),
            physics,
            steps=plan.steps,
            settings=settings,
            evaluate_every=plan.steps // EVALUATIONS,
        )

    return compilation.jit(seeds_lib.map_devices(train, plan.devices))


def _rows(
    context: Context,
    plan: Retraining,
    train: Callable[..., Evaluation],
    params: Any,
    seeds: np.ndarray,
) -> pl.DataFrame:
    """The evaluations of the agents of one reward of each seed."""
    # Every device takes as many agents: the first ones train again where they do not divide.
    count = seeds_lib.padded(len(seeds), 1, len(plan.devices))
    order = np.arange(count) % len(seeds)
    keys = seeds_lib.keys(jax.random.fold_in(context.key, AGENTS), context.seeds)[seeds]
    agents = jax.tree.map(lambda leaf: jnp.asarray(leaf)[order], (keys, params))
    found = jax.tree.map(lambda leaf: leaf[: len(seeds)], jax.device_get(train(agents)))
    shape = found.return_mean.shape
    seed, world, evaluation = (axis.reshape(-1) for axis in np.indices(shape))
    return pl.DataFrame(
        {
            "seed": seeds[seed],
            "physics": np.array(list(plan.physics))[world],
            "env_step": evaluation * (plan.steps // EVALUATIONS),
            "return_mean": found.return_mean.reshape(-1),
            "goal_fraction": found.goal_fraction.reshape(-1),
        }
    )


def measured(rows: pl.DataFrame) -> pl.DataFrame:
    """A row for each agent: method, n_demos, seed, physics and the measures.

    Args:
        rows: as `of_run` gives them.
    """
    last = pl.col("env_step").rank("dense", descending=True).over("method") <= AT_THE_END
    agents = (
        rows.filter(last)
        .group_by(*LEARNER, "physics", maintain_order=True)
        .agg(
            pl.col("return_mean").mean().alias("return"),
            pl.col("goal_fraction").mean().alias("goal"),
        )
    )
    true = agents.filter(pl.col("method") == TRUE)
    shared = ["seed", "physics"]
    return agents.join(
        true.select(*shared, pl.col("return").alias("true")), on=shared, how="left"
    ).select(pl.exclude("true"), (pl.col("true") - pl.col("return")).alias("regret"))


def figure(rows: pl.DataFrame, seeds: pl.DataFrame, threshold: float | None) -> Figure:
    """The mean return of each reward's agents over their steps, a panel for each physics.

    Args:
        rows: as `of_run` gives them; of those with demonstrations, the largest number is drawn.
        seeds: the run's table, whose `expert_id` says which seeds share an expert.
        threshold: return that counts as solved.
    """
    rows = with_experts(rows, seeds)
    rows = rows.filter(pl.col("n_demos").is_in([0, rows["n_demos"].max()]))
    physics = rows["physics"].unique(maintain_order=True).to_list()
    lines = curves.lines(rows["method"].unique(maintain_order=True))
    # What the others are compared with stands out.
    lines[TRUE] = {"color": "black", "linestyle": "-"}
    drawn = Figure(figsize=(4.2 * len(physics), 3.6), layout="constrained")
    panels = drawn.subplots(1, len(physics), sharey=True, squeeze=False)[0]
    for axes, world in zip(panels, physics, strict=True):
        curves.levels(axes, None, threshold)
        of_world = rows.filter(pl.col("physics") == world)
        for method, line in lines.items():
            of_method = of_world.filter(pl.col("method") == method)
            # A method's own label says how r_D joins r_e there: here it stands alone.
            name = "$r_e$" if method == TRUE else f"$r_D$: {method}"
            curves.band(axes, of_method, "env_step", "return_mean", name, line)
        axes.set_title(f"{world} physics" if world == OWN else world, fontsize=10)
        axes.set_xlabel("environment steps")
    panels[0].set_ylabel("return of $r_e$")
    curves.legend(drawn, panels[0], columns=2)
    return drawn
