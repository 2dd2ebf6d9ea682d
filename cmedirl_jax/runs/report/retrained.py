"""Fresh agents on a run's rewards alone, beside agents on r_e and on rewards that know nothing."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple

import flax.struct
import jax
import jax.numpy as jnp
import numpy as np
import polars as pl

from cmedirl_jax.assess import retraining
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.envs import Env
from cmedirl_jax.irl import controls
from cmedirl_jax.runs.drawing import Figure
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import LearnedCell
from cmedirl_jax.runs.report import curves
from cmedirl_jax.runs.report.reward_samples import Context, Sampled
from cmedirl_jax.training import seeds as seeds_lib
from cmedirl_jax.training.evaluation import Evaluation
from cmedirl_jax.training.settings import Settings

EVALUATIONS = 12
"""Evaluations of an agent, apart from the first."""
LAST = 3
"""Of these, the last ones whose mean is an agent's return."""
OWN = "own"
"""The physics that the rewards were learned under."""
TRUE = "r_e"
MEASURES = {
    "return": "return of r_e, mean of the last quarter of the evaluations",
    "goal": "share of episodes that the task ended, likewise",
    "regret": "return of an agent on r_e with the same networks and starts, less this one's",
}
"""What is measured, in words."""


class Plan(NamedTuple):
    """What to retrain.

    Attributes:
        env: the task.
        steps: environment steps of each agent.
        physics: parameters of the environment by name, `OWN` first.
        settings: of the agents.
        devices: that share the agents.
    """

    env: Env
    steps: int
    physics: Mapping[str, Any]
    settings: Settings
    devices: Sequence[Any]


def plan(
    context: Context,
    steps: int,
    changes: Sequence[str],
    settings: Settings,
    devices: Sequence[Any],
) -> Plan:
    """Check what a user asks for.

    Args:
        context: of the run.
        steps: environment steps of each agent.
        changes: of the environment's parameters, as "power=0.0012" or "a=1,b=2".
        settings: of the agents.
        devices: that share the agents.

    Raises:
        UserError: for a task that is not in JAX, a number of steps that is no multiple of the
            evaluations, or a change that the task does not know.
    """
    if not isinstance(context.env, Env):
        raise UserError(f"--retrain: {context.env.spec.id} is no task in JAX")
    if steps % EVALUATIONS:
        raise UserError(f"--retrain: {steps} is no multiple of {EVALUATIONS}, the evaluations")
    own = context.env.default_params
    physics = {OWN: own} | {change: _changed(own, change) for change in changes}
    return Plan(context.env, steps, physics, settings, devices)


def _changed(params: Any, change: str) -> Any:
    """Parameters with other numbers in some of their fields."""
    names = getattr(params, "_fields", None) or tuple(getattr(params, "__dataclass_fields__", ()))
    numbers: dict[str, Any] = {}
    for part in change.split(","):
        name, _, text = part.partition("=")
        if name not in names:
            there = ", ".join(names) or "none"
            raise UserError(f"--physics: {part} names none of the task's parameters: {there}")
        own = np.asarray(getattr(params, name))
        if own.ndim:
            raise UserError(
                f"--physics: {name} is {own.size} numbers, and can be changed in Python"
            )
        try:
            numbers[name] = own.dtype.type(text).item()
        except ValueError:
            raise UserError(f"--physics: {part} gives no number as {own.item()} is") from None
        if not np.isfinite(numbers[name]):
            raise UserError(f"--physics: {part} is not finite")
    if isinstance(params, flax.struct.PyTreeNode):
        return params.replace(**numbers)
    return params._replace(**numbers)


def of_cells(
    context: Context,
    plan: Plan,
    cells: Sequence[tuple[LearnedCell, Sampled]],
    say: Callable[[str], None],
) -> pl.DataFrame:
    """A row for each evaluation of each agent: its reward, physics, step, return and goals.

    Beside the rewards of the cells stand r_e, a random network that varies as much as they do on
    average over what demonstrations and policies visit, and constants of their size there.

    Args:
        context: of the run.
        plan: what to retrain.
        cells: that learned a reward, with the steps that it is judged by.
        say: called with a line about each reward before its agents train.
    """
    every = range(context.seeds)
    rewards: list[tuple[str, int, range, Rewards | None]] = [
        (name, 0, every, made) for name, made in _controls(context, cells).items()
    ]
    for cell, _ in cells:
        key = cell.cell.key
        rewards.append((key.method, key.n_demos, key.seed_range, Rewards(*cell.rewards())))
    found, programs = [], {}
    for method, n_demos, seeds, made in rewards:
        say(f"{method}: {len(seeds)} fresh agents, each under {len(plan.physics)} physics")
        pay = None if made is None else made.reward
        train = programs.setdefault(pay, _program(plan, pay))
        labels = (pl.lit(method).alias("method"), pl.lit(n_demos).alias("n_demos"))
        found.append(_rows(context, plan, train, made, seeds).select(*labels, pl.all()))
    return pl.concat(found)


def _controls(
    context: Context, cells: Sequence[tuple[LearnedCell, Sampled]]
) -> dict[str, Rewards | None]:
    """The rewards that the learned ones are compared with; None is r_e."""
    values = [_values(Rewards(*cell.rewards()), sampled) for cell, sampled in cells]
    size = np.mean([np.sqrt(np.square(each).mean(axis=1)).mean() for each in values])
    deviation = np.mean([each.std(axis=1).mean() for each in values])

    learner = controls.random(context.env.spec)
    states = jax.vmap(learner.init)(seeds_lib.keys(context.key, context.seeds))

    def random(params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        scale, state = params
        return scale * learner.reward(state, observation, action)

    def scaled(scale: float, seeds: range) -> Rewards:
        own = jax.tree.map(lambda leaf: leaf[np.array(seeds)], states)
        return Rewards(random, (jnp.full(len(seeds), scale, jnp.float32), own))

    def constant(params: jax.Array, observation: jax.Array, action: jax.Array) -> jax.Array:
        del action
        return jnp.broadcast_to(params, observation.shape[:-1])

    cell, sampled = cells[0]
    unscaled = _values(scaled(1.0, cell.cell.key.seed_range), sampled).std(axis=1).mean()
    sizes = jnp.full(context.seeds, size, jnp.float32)
    return {
        TRUE: None,
        "random": scaled(float(deviation / unscaled), range(context.seeds)),
        "+constant": Rewards(constant, sizes),
        "-constant": Rewards(constant, -sizes),
    }


def _values(rewards: Rewards, sampled: Sampled) -> np.ndarray:
    """`[R, N]`, what each reward pays for its learner's steps: demonstrations and policy."""
    steps = sampled.visited
    paid = jax.jit(jax.vmap(rewards.reward))(rewards.params, steps.observation, steps.action)
    return np.asarray(paid, np.float64)


def _program(plan: Plan, pay: Callable[..., jax.Array] | None) -> Callable[..., Evaluation]:
    """Trains agents on rewards of one function: `((keys, params) [R, ...]) -> Evaluation`."""
    physics = jax.tree.map(lambda *leaves: np.stack(leaves), *plan.physics.values())

    def train(agents: tuple[jax.Array, Any]) -> Evaluation:
        keys, params = agents
        return retraining.retrain(
            keys,
            plan.env,
            None if pay is None else Rewards(pay, params),
            physics,
            steps=plan.steps,
            settings=plan.settings,
            evaluate_every=plan.steps // EVALUATIONS,
        )

    return jax.jit(seeds_lib.map_devices(train, plan.devices))


def _rows(
    context: Context,
    plan: Plan,
    train: Callable[..., Evaluation],
    rewards: Rewards | None,
    seeds: range,
) -> pl.DataFrame:
    """The evaluations of the agents of one reward of each seed."""
    # Every device takes as many agents: the first ones train again where they do not divide.
    count = seeds_lib.padded(len(seeds), 1, len(plan.devices))
    order = np.arange(count) % len(seeds)
    keys = seeds_lib.keys(context.key, seeds.stop)[seeds.start :]
    params = () if rewards is None else rewards.params
    agents = jax.tree.map(lambda leaf: jnp.asarray(leaf)[order], (keys, params))
    found = jax.tree.map(lambda leaf: leaf[: len(seeds)], jax.device_get(train(agents)))
    shape = found.return_mean.shape
    seed, world, evaluation = (axis.reshape(-1) for axis in np.indices(shape))
    return pl.DataFrame(
        {
            "seed": seeds.start + seed,
            "physics": np.array(list(plan.physics))[world],
            "env_step": evaluation * (plan.steps // EVALUATIONS),
            "return_mean": found.return_mean.reshape(-1),
            "goal_fraction": found.goal_fraction.reshape(-1),
        }
    )


def measured(rows: pl.DataFrame) -> pl.DataFrame:
    """A row for each agent: method, n_demos, seed, physics and the measures.

    Args:
        rows: as `of_cells` gives them.
    """
    last = pl.col("env_step").rank("dense", descending=True).over("method") <= LAST
    agents = (
        rows.filter(last)
        .group_by("method", "n_demos", "seed", "physics", maintain_order=True)
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


def figure(rows: pl.DataFrame, threshold: float | None) -> Figure:
    """The mean return of each reward's agents over their steps, a panel for each physics."""
    physics = rows["physics"].unique(maintain_order=True).to_list()
    drawn = Figure(figsize=(4.2 * len(physics), 3.6), layout="constrained")
    panels = drawn.subplots(1, len(physics), sharey=True, squeeze=False)[0]
    rows = rows.with_columns(expert_id=pl.lit(None, pl.Int32))
    most = rows["n_demos"].max()
    shown = rows.filter(pl.col("n_demos").is_in([0, most]))
    for axes, world in zip(panels, physics, strict=True):
        curves.levels(axes, None, threshold)
        for index, ((method,), of_method) in enumerate(
            shown.filter(pl.col("physics") == world).group_by("method", maintain_order=True)
        ):
            line = {
                "color": curves.COLOURS[index % len(curves.COLOURS)],
                "linestyle": curves.STYLES[index // len(curves.COLOURS)],
            }
            curves.band(axes, of_method, "env_step", "return_mean", str(method), line)
        axes.set_title(f"{world} physics" if world == OWN else world, fontsize=10)
        axes.set_xlabel("environment steps")
    panels[0].set_ylabel("return of $r_e$")
    curves.legend(drawn, panels[0], columns=4)
    return drawn
