"""`python -m experiments.optimal_return`: the best return that any policy can have, by start state.

Value iteration on ever finer grids gives V* of the environment's own reward: undiscounted with the
time limit, and at the agent's discount without one. V* on a grid is an approximation, so each row
also has the return that a policy looking one step ahead by it attains in the continuous task.
"""

import dataclasses
import functools
import sys
from collections.abc import Sequence
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import polars as pl
from rich import box
from rich.table import Table

from cmedirl_jax import envs
from cmedirl_jax.envs import Env
from cmedirl_jax.ranges import AtLeastTwo, BelowOne, Size
from cmedirl_jax.runs import start
from cmedirl_jax.runs.console import compile_cache, ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.storage import outputs
from cmedirl_jax.tabular import discretise, interpolation
from cmedirl_jax.tabular.discretise import FiniteMDP
from cmedirl_jax.tabular.optimal_control import value_iteration


@dataclasses.dataclass(frozen=True)
class Options:
    """Which grids, which discount, and where to write it.

    Attributes:
        env: The environment, by Gymnasium's name.
        states: Points along each dimension of the observation, a grid for each.
        actions: Points along each dimension of the action.
        discount: The agent's; the undiscounted optimum is computed too.
        starts: Start states, those of the evaluations of `tuned`.
        out: A CSV file for the table of all starts.
    """

    env: str = "MountainCarContinuous-v0"
    states: tuple[AtLeastTwo, ...] = (101, 201, 401)
    actions: AtLeastTwo = 21
    discount: BelowOne = 0.99
    starts: Size = 10
    out: Path | None = None


@ending.in_a_line("optimal_return")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "experiments.optimal_return", __doc__, arguments)
    compile_cache.use_cache()
    outputs.check("out", options.out)
    start.devices()
    try:
        table = optimal_returns(options)
    except ValueError as error:
        raise UserError(str(error)) from error
    console = screen.console()
    screen.show(console, means(table, options.starts))
    if options.out is not None:
        outputs.write(options.out, table.write_csv().encode())
        screen.say(console, f"Table: {options.out}")
    return 0


def means(table: pl.DataFrame, starts: int) -> Table:
    """The means over the start states as a table for the screen."""
    shown = Table(title=f"means over {starts} start states", box=box.SIMPLE)
    names = ("states", "discount", "value", "attained", "attained_return")
    for name in names:
        shown.add_column(name.replace("_", " "), justify="right")
    rows = table.group_by("states", "discount", maintain_order=True).mean()
    for row in rows.select(names).iter_rows():
        shown.add_row(*(f"{value:.6g}" for value in row))
    return shown


def optimal_returns(options: Options) -> pl.DataFrame:
    """A row for each grid, discount and start.

    `value` is V* on the grid; `attained` the discounted, `attained_return` the undiscounted return
    of the policy that looks one step ahead by it.

    Raises:
        ValueError: for an unknown environment, one that cannot be discretised, or a grid that is
            too large.
    """
    env = envs.make(options.env)
    spec, params = env.spec, env.default_params
    first = np.asarray(env.starts(options.starts, params)[1])
    actions = (options.actions,) * spec.action_dim
    makes = [
        functools.partial(discretise.make, env, (size,) * spec.observation_dim, actions)
        for size in options.states
    ]
    # A grid that is too large is refused before the others are solved.
    for make in makes:
        jax.eval_shape(make)
    rows = []
    for size, make in zip(options.states, makes, strict=True):
        mdp = jax.jit(make)()
        for discount, horizon in ((1.0, spec.max_episode_steps), (options.discount, None)):
            solve = jax.jit(functools.partial(_solve, env=env, horizon=horizon))
            value, attained, attained_return = jax.device_get(solve(mdp, first, discount))
            rows.append(
                pl.DataFrame(
                    {
                        "states": size,
                        "discount": discount,
                        "start": first[:, 0],
                        "value": value,
                        "attained": attained,
                        "attained_return": attained_return,
                    }
                )
            )
    return pl.concat(rows)


def _solve(
    mdp: FiniteMDP, first: jax.Array, discount: float, *, env: Env, horizon: int | None
) -> tuple[jax.Array, jax.Array, jax.Array]:
    """V* at the start states, and the two returns of the policy that looks one step ahead by it."""
    best = value_iteration(
        mdp.dynamics, mdp.reward, discount=discount, horizon=horizon, absorbing=mdp.absorbing
    )
    params = env.default_params
    actions = jnp.asarray(interpolation.points(mdp.actions))
    assert env.state_at is not None
    state_at = env.state_at

    # The value of an action: its reward, and V* where it leads.
    def ahead(values: jax.Array, observation: jax.Array, action: jax.Array) -> jax.Array:
        step = env.step(jax.random.key(0), state_at(observation, params), action, params)[1]
        later = jnp.where(step.terminated, 0.0, discretise.look_up(mdp, values, step.observation))
        return step.reward + discount * later

    def advance(carry, time: jax.Array):
        states, observation, done, earned, total = carry
        # V* of the steps that remain.
        values = best.values
        if horizon is not None:
            following = values[jnp.minimum(time + 1, horizon - 1)]
            values = jnp.where(time + 1 < horizon, following, 0.0)
        # Take the action of the grid that is worth most.
        over_actions = jax.vmap(ahead, in_axes=(None, None, 0))
        worth = jax.vmap(over_actions, in_axes=(None, 0, None))(values, observation, actions)
        action = actions[jnp.argmax(worth, axis=-1)]
        states, step = jax.vmap(env.step, in_axes=(None, 0, 0, None))(
            jax.random.key(0), states, action, params
        )
        # Count its reward while the episode runs.
        reward = jnp.where(done, 0.0, step.reward)
        done = done | step.terminated | step.truncated
        earned = earned + discount**time * reward
        return (states, step.observation, done, earned, total + reward), None

    zeros = jnp.zeros(first.shape[0])
    states = jax.vmap(state_at, in_axes=(0, None))(first, params)
    carry = (states, first, zeros > 0, zeros, zeros)
    (*_, earned, total), _ = jax.lax.scan(advance, carry, jnp.arange(env.spec.max_episode_steps))
    values = best.values if horizon is None else best.values[0]
    return discretise.look_up(mdp, values, first), earned, total


if __name__ == "__main__":
    sys.exit(main())
