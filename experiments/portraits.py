"""`python -m experiments.portraits RUN`: paths of learned policies on the value of the optimum.

A panel for each method: V* of the environment's own reward at the agent's discount, by value
iteration on a grid, and the episodes of a few seeds' best policies from one start state.
"""

import dataclasses
import functools
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro

from cmedirl_jax import envs
from cmedirl_jax.envs import Env
from cmedirl_jax.ranges import AtLeastTwo, Size
from cmedirl_jax.runs import drawing, start
from cmedirl_jax.runs.console import compile_cache, ending, screen
from cmedirl_jax.runs.console.options import read
from cmedirl_jax.runs.drawing import Figure
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import load_policy
from cmedirl_jax.runs.storage import cells, outputs
from cmedirl_jax.runs.storage import folder as run_folder
from cmedirl_jax.tabular import discretise
from cmedirl_jax.tabular.optimal_control import value_iteration
from cmedirl_jax.training.methods import METHODS

COLUMNS = 4


@dataclasses.dataclass(frozen=True)
class Options:
    """Which run, how many policies, and where to draw them.

    Attributes:
        folder: A run's folder.
        seeds: Policies of each method, of seeds 0, 1, ...
        states: Points along each dimension of the observation, for V*.
        actions: Points along the action, for V*.
        out: A PNG or SVG file.
    """

    folder: Annotated[Path, tyro.conf.Positional]
    seeds: Size = 8
    states: AtLeastTwo = 151
    actions: AtLeastTwo = 21
    out: Path = Path("portraits.png")


class ValueMap(NamedTuple):
    """V* on a grid of two observations.

    Attributes:
        first: `[N]`, points of the first observation.
        second: `[M]`, points of the second one.
        value: `[N, M]`.
    """

    first: np.ndarray
    second: np.ndarray
    value: np.ndarray


@ending.in_a_line("portraits")
def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit code."""
    options = read(Options, "experiments.portraits", __doc__, arguments)
    if options.out.suffix not in (".png", ".svg"):
        raise UserError(f"--out: {options.out} is no PNG or SVG file")
    outputs.check("out", options.out)
    config = run_folder.read(options.folder)["config"]
    compile_cache.use_cache()
    start.devices()
    try:
        env = envs.find(config["env"])
        if not isinstance(env, Env):
            raise UserError(f"{options.folder}: it needs a task in JAX, {env.spec.id} is not")
        discount = config["settings"]["agent"]["discount"]
        best = value_map(env, discount, options.states, options.actions)
        episodes = of_methods(options.folder, config, env, options.seeds)
    except (LookupError, ValueError) as error:
        raise UserError(" ".join(str(error).split())) from error
    complaints: list[str] = []
    drawing.save(lambda: portraits(best, episodes), [options.out], complaints.append)
    if complaints:
        raise UserError(complaints[0])
    screen.say(screen.console(), f"Portraits: {options.out}")
    return 0


def value_map(env: Env, discount: float, states: int, actions: int) -> ValueMap:
    """V* of the environment's own reward.

    Raises:
        ValueError: if the task does not have two observations and one action, or cannot be
            discretised.
    """
    spec = env.spec
    if (spec.observation_dim, spec.action_dim) != (2, 1):
        raise ValueError(f"{spec.id}: only a task of two observations and one action is drawn")

    @jax.jit
    def solve() -> jax.Array:
        mdp = discretise.make(env, (states, states), (actions,))
        found = value_iteration(
            mdp.dynamics, mdp.reward, discount=discount, absorbing=mdp.absorbing
        )
        # The last state is the absorbing one.
        return found.values[:-1].reshape(states, states)

    first, second = (
        np.linspace(low, high, states)
        for low, high in zip(spec.observation_low, spec.observation_high, strict=True)
    )
    return ValueMap(first, second, np.asarray(solve()))


def of_methods(
    folder: Path, config: Mapping[str, Any], env: Env, seeds: int
) -> dict[str, list[np.ndarray]]:
    """The episodes of each method's seeds, at the largest number of demonstrations.

    Raises:
        ValueError: if a policy is missing or damaged.
    """
    most = dict(cells.asked(config["methods"], sorted(config["n_demos"])))
    return {
        method: [episode(load_policy(folder, method, seed, n), env) for seed in range(seeds)]
        for method, n in most.items()
    }


def episode(policy: Callable[[jax.Array], jax.Array], env: Env) -> np.ndarray:
    """Observations `[T + 1, O]` of an episode from the middle one of three start states."""

    def advance(carry, _):
        state, observation, done = carry
        state, step = env.step(jax.random.key(0), state, policy(observation), params)
        done = done | step.terminated | step.truncated
        return (state, step.observation, done), (step.observation, done)

    params = env.default_params
    state, observation = jax.tree.map(lambda leaf: leaf[1], env.starts(3, params))
    run = jax.jit(functools.partial(jax.lax.scan, advance, length=env.spec.max_episode_steps))
    _, (observations, done) = run((state, observation, jnp.zeros((), bool)), None)
    length = int(np.argmax(np.asarray(done))) + 1 if np.any(done) else len(done)
    return np.concatenate([np.asarray(observation)[None], np.asarray(observations)[:length]])


def portraits(best: ValueMap, episodes: Mapping[str, Sequence[np.ndarray]]) -> Figure:
    """A panel for each method: V* in colour, and the paths `[T + 1, 2]` of its episodes."""
    columns = min(COLUMNS, len(episodes))
    rows = -(-len(episodes) // columns)
    figure = Figure(figsize=(2.9 * columns + 0.8, 2.8 * rows), layout="constrained")
    panels = list(figure.subplots(rows, columns, sharex=True, sharey=True, squeeze=False).flat)
    shown = None
    for (method, paths), axes in zip(episodes.items(), panels, strict=False):
        shown = axes.pcolormesh(
            best.first, best.second, best.value.T, cmap="cividis", rasterized=True
        )
        for path in paths:
            axes.plot(path[:, 0], path[:, 1], color="white", linewidth=0.8)
            axes.plot(*path[-1], "o", color="white", markersize=3)
        axes.set_title(METHODS[method].label or method, fontsize=10)
    for axes in panels[len(episodes) :]:
        axes.set_axis_off()
    assert shown is not None
    figure.colorbar(shown, ax=panels, label="value of the optimum")
    figure.supxlabel("position", fontsize=10)
    figure.supylabel("velocity", fontsize=10)
    return figure


if __name__ == "__main__":
    sys.exit(main())
