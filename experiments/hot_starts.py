"""`python -m experiments.hot_starts --demos POOL`: the critic's hot starts, by what they change.

All five losses leave the actor as it is, so that the policy at step 0 says nothing of them.
Compared are the critic's values against the returns of the demonstrations, whether it prefers
demonstrated actions, and what DDPG's first updates by it, on demonstrated minibatches, make of the
actor.
"""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, get_args, get_type_hints

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
from rich import box
from rich.table import Table

from cmedirl_jax import envs, networks, observation_statistics
from cmedirl_jax.agents import ddpg, hot_start
from cmedirl_jax.agents.hot_start import HotStartData, HotStartHParams
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import DemonstrationSubset
from cmedirl_jax.envs import Env
from cmedirl_jax.ranges import Size
from cmedirl_jax.runs import demonstrations as given
from cmedirl_jax.runs import intervals, start
from cmedirl_jax.runs.cells import pools
from cmedirl_jax.runs.cells.pools import LearnersPool
from cmedirl_jax.runs.console import compile_cache, ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs
from cmedirl_jax.training import evaluation

CRITICS: tuple[str, ...] = get_args(get_type_hints(HotStartHParams)["critic"])
SAMPLE = 2_000
"""Demonstrated steps that the values are compared on."""


@dataclasses.dataclass(frozen=True)
class Options:
    """Whose demonstrations, how many learners, and where to write the table.

    Attributes:
        demos: A demonstrations file, such as the pool of a run.
        env: The environment, by Gymnasium's name.
        seeds: Learners.
        updates: Updates of DDPG after the hot start.
        starts: Start states of the evaluations.
        out: A CSV file for the table.
    """

    demos: Path
    env: str = "MountainCarContinuous-v0"
    seeds: Size = 100
    updates: Size = 200
    starts: Size = 10
    out: Path | None = None


class Found(NamedTuple):
    """What a hot start made of one learner; numbers, or `[seeds]`.

    Attributes:
        correlation: of Q(s, a) with the discounted return, over demonstrated steps.
        error: root of the mean squared difference between the two.
        preference: share of these steps at which Q is higher than at a uniformly drawn action.
        action_change: root of the mean squared change of the actor's actions by the updates, at
            demonstrated observations.
        return_before: from the evaluation starts, after the hot start.
        return_after: after the updates.
    """

    correlation: jax.Array
    error: jax.Array
    preference: jax.Array
    action_change: jax.Array
    return_before: jax.Array
    return_after: jax.Array


@ending.in_a_line("hot_starts")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "experiments.hot_starts", __doc__, arguments)
    outputs.check("out", options.out)
    compile_cache.use_cache()
    start.devices()
    try:
        env = envs.find(options.env)
    except ValueError as error:
        raise UserError(f"--env: {error}") from error
    if not isinstance(env, Env):
        raise UserError(f"--env: it needs a task in JAX, {options.env} is not")
    pool = given.load(options.demos, env, "dynamics")
    shared = pools.of_learners(pool, options.seeds)
    table = pl.DataFrame([_row(critic, shared, env, options) for critic in CRITICS])
    screen.show(screen.console(), shown(table))
    if options.out is not None:
        outputs.write(options.out, table.write_csv().encode())
    return 0


def _row(critic: str, pool: LearnersPool, env: Env, options: Options) -> dict[str, object]:
    found = of_critic(critic, pool.data, env, options)
    experts = pool.expert if (pool.expert >= 0).all() else None
    row: dict[str, object] = {"critic": critic, "seeds": options.seeds}
    for name, values in found._asdict().items():
        interval = intervals.mean(np.asarray(values, float), clusters=experts)
        row |= {name: interval.estimate, f"{name}_low": interval.low, f"{name}_high": interval.high}
    return row


def of_critic(critic: str, data: HotStartData, env: Env, options: Options) -> Found:
    """What a critic's loss makes of every learner, leaves `[seeds]`."""
    one = jax.jit(functools.partial(_of_learner, critic, data, env, options))
    keys = jax.random.split(jax.random.key(0), options.seeds)
    # One after the other: a learner's networks stay in the cache.
    return jax.device_get(jax.lax.map(lambda x: one(*x), (keys, data.episodes)))


def _of_learner(
    critic: str,
    data: HotStartData,
    env: Env,
    options: Options,
    key: jax.Array,
    subset: DemonstrationSubset,
) -> Found:
    made = networks.make(env.spec)
    agent = ddpg.make(env.spec, networks=made)
    init_key, fit_key, sample_key, action_key, update_key = jax.random.split(key, 5)

    # The hot start.
    actor_key, critic_key = jax.random.split(init_key)
    drawn = made.actor.init(actor_key), made.critic.init(critic_key)
    shown = demonstrations.sample_index(sample_key, subset, SAMPLE)
    statistics = observation_statistics.of_sample(jnp.asarray(data.transition.observation)[shown])
    drawn = observation_statistics.put(drawn, statistics)
    hparams = HotStartHParams(critic=critic)  # type: ignore[arg-type]
    state = agent.init(init_key, hot_start.fit(fit_key, made, drawn, data, hparams, subset=subset))

    # Its values.
    steps = jax.tree.map(lambda leaf: jnp.asarray(leaf)[shown], data.transition)
    returns = jnp.asarray(data.discounted_return)[shown]
    value = agent.value(state, steps.observation, steps.action)
    other = jax.random.uniform(
        action_key, steps.action.shape, minval=env.spec.action_low, maxval=env.spec.action_high
    )
    preferred = value > agent.value(state, steps.observation, other)

    # The first updates, on demonstrated minibatches.
    def update(state, key):
        chosen = demonstrations.sample_index(key, subset, 32)
        batch = jax.tree.map(lambda leaf: jnp.asarray(leaf)[chosen], data.transition)
        return agent.update(state, batch)[0], None

    later, _ = jax.lax.scan(update, state, jax.random.split(update_key, options.updates))
    change = agent.act(later, steps.observation) - agent.act(state, steps.observation)

    def returned(state) -> jax.Array:
        policy = functools.partial(agent.act, state)
        return evaluation.evaluate(policy, env, env.default_params, options.starts).return_mean

    return Found(
        correlation=jnp.corrcoef(value, returns)[0, 1],
        error=jnp.sqrt(jnp.mean(jnp.square(value - returns))),
        preference=jnp.mean(preferred.astype(jnp.float32)),
        action_change=jnp.sqrt(jnp.mean(jnp.square(change))),
        return_before=returned(state),
        return_after=returned(later),
    )


def shown(table: pl.DataFrame) -> Table:
    """The table for the screen."""
    printed = Table(title="means over the learners; 95% intervals", box=box.SIMPLE)
    printed.add_column("critic")
    for name in Found._fields:
        printed.add_column(name.replace("_", " "), justify="right")
    for row in table.iter_rows(named=True):
        cells = (
            f"{row[name]:.2f}\n\\[{row[f'{name}_low']:.2f}, {row[f'{name}_high']:.2f}]"
            for name in Found._fields
        )
        printed.add_row(row["critic"], *cells)
    return printed


if __name__ == "__main__":
    sys.exit(main())
