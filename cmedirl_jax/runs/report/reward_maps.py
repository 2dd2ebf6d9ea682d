"""Pictures of learned rewards over a task's two observations, beside the task's own."""

import functools
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import normalisation
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.envs import Env
from cmedirl_jax.runs.drawing import Axes, Figure
from cmedirl_jax.runs.report import curves
from cmedirl_jax.runs.report.reward_samples import Learners, RewardedRun
from cmedirl_jax.tabular import discretise, interpolation
from cmedirl_jax.tabular.discretise import FiniteMDP
from cmedirl_jax.tabular.optimal_control import value_iteration

POINTS = 61
"""Points along each observation."""
ACTIONS = 21
"""Points along the action, for the value of the optimum."""
SHOWN = (0, ACTIONS // 2, ACTIONS - 1)
"""The actions that are shown: the least, the middle one and the largest."""


STEPS = 16
"""Steps of each seed that are drawn."""


def fits(env: Any) -> bool:
    """Whether a task can be drawn: two bounded observations, one action, and known dynamics."""
    return (
        isinstance(env, Env)
        and env.state_at is not None
        and (env.spec.observation_dim, env.spec.action_dim) == (2, 1)
        and bool(normalisation.sensible(env.spec).all())
    )


def of_run(run: RewardedRun) -> Callable[[], Figure] | None:
    """Draws the rewards of the largest number of demonstrations; None if the task cannot be."""
    env = run.context.env
    if not isinstance(env, Env) or not fits(env):
        return None
    most = max(learners.n_demos for learners in run.learners)
    shown = [learners for learners in run.learners if learners.n_demos in (0, most)]
    return functools.partial(maps, env, run.context.discount, shown)


def maps(env: Env, discount: float, learned: Sequence[Learners]) -> Figure:
    """A row for the task's own reward and the optimum's value, and a row for each method.

    Args:
        env: a task that `fits`.
        discount: gamma, of V*.
        learned: of each method.
    """
    mdp = jax.jit(lambda: discretise.make(env, (POINTS, POINTS), (ACTIONS,)))()
    best = jax.jit(
        lambda: (
            value_iteration(
                mdp.dynamics, mdp.reward, discount=discount, absorbing=mdp.absorbing
            ).values
        )
    )()
    rows = 1 + len(learned)
    figure = Figure(figsize=(11, 2.2 * rows), layout="constrained")
    panels = figure.subplots(rows, 4, sharex=True, sharey=True, squeeze=False)
    points = interpolation.points(mdp.actions)[list(SHOWN), 0]
    reward = np.asarray(mdp.reward)[:-1][:, list(SHOWN)]
    # The bonus at the end would hide all other differences.
    _row(figure, panels[0], mdp, np.clip(reward, None, 1.0), "$r_e$, at most 1", points)
    _map(figure, panels[0][3], mdp, np.asarray(best)[:-1], "$V^*$")
    for axes, each in zip(panels[1:], learned, strict=True):
        mean = np.asarray(_mean(each.rewards, mdp))
        _row(figure, axes, mdp, mean, f"{curves.label(each.method.name)}, mean $r_D$", points)
        _visits(axes[3], each)
    figure.supxlabel("first observation", fontsize=10)
    figure.supylabel("second observation", fontsize=10)
    return figure


def _mean(rewards: Rewards, mdp: FiniteMDP) -> jax.Array:
    """`[S, len(SHOWN)]`, the mean of the seeds' rewards."""
    states = jnp.asarray(interpolation.points(mdp.states))
    actions = jnp.asarray(interpolation.points(mdp.actions))[jnp.array(SHOWN)]
    pairs = jnp.broadcast_to(states[:, None], (len(states), len(SHOWN), 2))
    tried = jnp.broadcast_to(actions[None], (len(states), len(SHOWN), 1))
    every = jax.jit(lambda each: jax.lax.map(lambda one: rewards.reward(one, pairs, tried), each))
    return jnp.mean(every(rewards.params), axis=0)


def _row(
    figure: Figure,
    axes: Sequence[Axes],
    mdp: FiniteMDP,
    values: np.ndarray,
    name: str,
    actions: np.ndarray,
) -> None:
    """A map for each shown action, with one scale of colours."""
    low, high = float(values.min()), float(values.max())
    if low == high:
        low, high = low - 1.0, high + 1.0
    shown = []
    for panel, action, column in zip(axes, actions, values.T, strict=False):
        shown.append(_draw(panel, mdp, column, low, high))
        panel.set_title(f"action {action:g}", fontsize=9)
    axes[0].set_ylabel(name, fontsize=9)
    figure.colorbar(shown[-1], ax=list(axes[: len(shown)]))


def _map(figure: Figure, axes: Axes, mdp: FiniteMDP, values: np.ndarray, name: str) -> None:
    shown = _draw(axes, mdp, values, float(values.min()), float(values.max()))
    axes.set_title(name, fontsize=9)
    figure.colorbar(shown, ax=axes)


def _draw(axes: Axes, mdp: FiniteMDP, values: np.ndarray, low: float, high: float) -> Any:
    first, second = (
        np.linspace(*ends, POINTS) for ends in zip(mdp.states.low, mdp.states.high, strict=True)
    )
    table = values.reshape(POINTS, POINTS).T
    return axes.pcolormesh(
        first, second, table, cmap="cividis", vmin=low, vmax=high, rasterized=True
    )


def _visits(axes: Axes, learned: Learners) -> None:
    for steps, colour, name in (
        (learned.demonstrated, curves.COLOURS[1], "demonstrations"),
        (learned.played, curves.COLOURS[0], "policies"),
    ):
        seen = steps.observation[:, :STEPS].reshape(-1, 2)
        axes.plot(*seen.T, ".", color=colour, markersize=1.5, alpha=0.4, label=name)
    axes.set_title("visited", fontsize=9)
    axes.legend(loc="lower left", fontsize=7, markerscale=6, frameon=False)
