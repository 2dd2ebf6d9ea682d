"""Fresh agents on a run's rewards alone, beside agents on r_e and on rewards that know nothing."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl

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


class Plan(NamedTuple):
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


def plan(env: Env | HostEnv, steps: int, changes: Sequence[str], devices: Sequence[Any]) -> Plan:
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
    return Plan(env, steps, {OWN: own} | {name: _changed(own, name) for name in changes}, devices)


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


def of_run(run: RewardedRun, plan: Plan, say: Callable[[str], None]) -> Iterator[pl.DataFrame]:
    """Train agents on each reward in turn.

    Beside the learned rewards stand r_e, a random network that varies as much as they do over what
    demonstrations and policies visit, and constants of their size there (medians over methods).
    Rewards are paid as they were learned, whatever their scale.

    Args:
        run: the rewards.
        plan: what to retrain.
        say: called with a line about each reward before its agents train.

    Yields:
        A row for each evaluation of each agent of a reward: method, n_demos, seed, physics, step,
        return and goals.
    """
    every = np.arange(run.context.seeds)
    rewards: list[tuple[str, int, np.ndarray, Rewards | None]] = [
        (name, 0, every, made) for name, made in _controls(run).items()
    ]
    rewards += [(each.method.name, each.n_demos, each.seeds, each.rewards) for each in run.learners]
    settings, programs = run.learners[0].settings, {}
    for method, n_demos, seeds, made in rewards:
        say(f"{method}: {len(seeds)} fresh agents, each under {len(plan.physics)} physics")
        pay = None if made is None else made.reward
        train = programs.setdefault(pay, _program(plan, settings, pay))
        labels = (pl.lit(method).alias("method"), pl.lit(n_demos).alias("n_demos"))
        yield _rows(run.context, plan, train, made, seeds).select(*labels, pl.all())


def _controls(run: RewardedRun) -> dict[str, Rewards | None]:
    """The rewards that the learned ones are compared with; None is r_e."""
    values = [_values(each.rewards, each.visited) for each in run.learners]
    # Medians over the methods: the rewards of one may be thousands of times as large.
    size = np.median([np.sqrt(np.square(each).mean(axis=1)).mean() for each in values])
    deviation = np.median([each.std(axis=1).mean() for each in values])

    learner = controls.random(run.context.env.spec)
    key = jax.random.fold_in(run.context.key, NETWORKS)
    states = jax.vmap(learner.init)(seeds_lib.keys(key, run.context.seeds))

    def random(params: Any, observation: jax.Array, action: jax.Array) -> jax.Array:
        scale, state = params
        return scale * learner.reward(state, observation, action)

    def scaled(scale: float, seeds: np.ndarray) -> Rewards:
        own = jax.tree.map(lambda leaf: leaf[seeds], states)
        return Rewards(random, (jnp.full(len(seeds), scale, jnp.float32), own))

    def constant(params: jax.Array, observation: jax.Array, action: jax.Array) -> jax.Array:
        del action
        return jnp.broadcast_to(params, observation.shape[:-1])

    first, every = run.learners[0], np.arange(run.context.seeds)
    unscaled = _values(scaled(1.0, first.seeds), first.visited).std(axis=1).mean()
    sizes = jnp.full(len(every), size, jnp.float32)
    return {
        TRUE: None,
        "random": scaled(float(deviation / unscaled), every),
        "+constant": Rewards(constant, sizes),
        "-constant": Rewards(constant, -sizes),
    }


def _values(rewards: Rewards, steps: Transition) -> np.ndarray:
    """`[R, N]`, what each reward pays for steps `[R, N, ...]`."""
    paid = jax.jit(jax.vmap(rewards.reward))(rewards.params, steps.observation, steps.action)
    return np.asarray(paid, np.float64)


def _program(
    plan: Plan, settings: Settings, pay: Callable[..., jax.Array] | None
) -> Callable[..., Evaluation]:
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
            settings=settings,
            evaluate_every=plan.steps // EVALUATIONS,
        )

    return jax.jit(seeds_lib.map_devices(train, plan.devices))


def _rows(
    context: Context,
    plan: Plan,
    train: Callable[..., Evaluation],
    rewards: Rewards | None,
    seeds: np.ndarray,
) -> pl.DataFrame:
    """The evaluations of the agents of one reward of each seed."""
    # Every device takes as many agents: the first ones train again where they do not divide.
    count = seeds_lib.padded(len(seeds), 1, len(plan.devices))
    order = np.arange(count) % len(seeds)
    keys = seeds_lib.keys(jax.random.fold_in(context.key, AGENTS), context.seeds)[seeds]
    params = () if rewards is None else rewards.params
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
    curves.legend(drawn, panels[0], columns=4)
    return drawn
