"""Report cards of the rewards that a run has learned: what each knows of the true reward."""

import functools
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np
import polars as pl

from cmedirl_jax import normalisation
from cmedirl_jax.assess import card, coverage
from cmedirl_jax.assess.card import Rewards
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv
from cmedirl_jax.runs import intervals
from cmedirl_jax.runs.report.reward_samples import Context, Learners, RewardedRun, with_experts
from cmedirl_jax.tabular import discretise

COMPARED, DRAWS = 4_096, 64
"""Transitions that a reward is compared on, and draws that its canonical form averages over."""
APART = 256
"""Steps of which the occupancies' distances are taken."""
GRID = {1: 201, 2: 51}
"""Points along each dimension of one or two observations; more have no grid."""
ACTIONS = 11
MEASURES = {
    "epic_uniform": "EPIC distance to r_e over the whole space (0: the same, 0.71: unrelated)",
    "epic_visited": "EPIC distance to r_e where demonstrations and policies go",
    "dard_uniform": "DARD distance to r_e over the whole space",
    "dard_visited": "DARD distance to r_e where demonstrations and policies go",
    "starc": "STARC distance to r_e on a grid",
    "correlation": "correlation with r_e where demonstrations and policies go",
    "advantage": "correlation with the optimum's advantage on a grid",
    "auc": "how often a demonstrated step is paid more than one of the policy (AUC)",
    "auc_held_out": "the same for demonstrations that the learner could not see",
    "largest": "largest r_D of these steps",
    "loitering": "the same as a share of the reward above which never ending pays",
    "discrepancy": "maximum mean discrepancy of demonstrations and policy",
    "wasserstein": "their sliced Wasserstein distance",
}
"""What is measured, in words."""


def of_run(run: RewardedRun) -> pl.DataFrame:
    """A row for each reward: method, n_demos, seed and the measures; null where there is none."""
    return pl.concat([_of(run.context, each) for each in run.learners], how="diagonal")


def _of(context: Context, learners: Learners) -> pl.DataFrame:
    rewards, columns = learners.rewards, {}
    # Against demonstrations.
    told = jax.jit(lambda *args: card.told(Rewards(rewards.reward, args[0]), *args[1:]))
    seen = told(rewards.params, learners.demonstrated, learners.played)._asdict()
    columns |= {name: values for name, values in seen.items() if name != "smallest"}
    if learners.held_out is not None:
        unseen = told(rewards.params, learners.held_out, learners.played)
        columns["auc_held_out"] = unseen.auc
    bonus = _bonus(context.pool)
    if bonus is not None:
        columns["loitering"] = columns["largest"] / card.loitering(context.discount, bonus)
    scale = _half_widths(context.env)
    apart = jax.jit(functools.partial(card.occupancies, context.key, scale))
    few = (
        jax.tree.map(lambda leaf: leaf[:, :APART], each)
        for each in (learners.demonstrated, learners.played)
    )
    columns |= apart(*few)._asdict()
    # Against the task's own reward.
    if isinstance(context.env, Env) and context.env.state_at is not None:
        columns |= _against_truth(context, context.env, learners)
    return learners.table({name: columns[name] for name in MEASURES if name in columns})


def _bonus(pool: Demonstrations) -> float | None:
    """What the task pays at its end, where that is a bonus."""
    ends = np.asarray(pool.transition.reward)[np.asarray(pool.transition.terminated)]
    known = ends[np.isfinite(ends)]
    return float(known.max()) if known.size and known.max() > 0 else None


def _half_widths(env: Env | HostEnv) -> np.ndarray:
    """`[O + A]`; 1 where a bound says nothing."""
    of_actions = (env.spec.action_high - env.spec.action_low) / 2
    return np.concatenate([normalisation.make(env.spec, "bounds").half_width, of_actions])


def _against_truth(context: Context, env: Env, learners: Learners) -> dict[str, Any]:
    columns: dict[str, Any] = {}
    rewards = learners.rewards
    for name, made in _coverages(context, env, learners):
        found = jax.jit(
            lambda params, made: card.truth(
                Rewards(rewards.reward, params), env, made, context.discount
            )
        )(rewards.params, made)
        columns |= {f"epic_{name}": found.epic, f"dard_{name}": found.dard}
        columns["correlation"] = found.correlation
    points = GRID.get(env.spec.observation_dim)
    if points is not None and normalisation.sensible(env.spec).all():
        mdp = jax.jit(
            lambda: discretise.make(
                env, (points,) * env.spec.observation_dim, (ACTIONS,) * env.spec.action_dim
            )
        )()
        found = jax.jit(
            lambda params: card.on_grid(Rewards(rewards.reward, params), mdp, context.discount)
        )(rewards.params)
        columns |= found._asdict()
    return columns


def _coverages(
    context: Context, env: Env, learners: Learners
) -> Iterator[tuple[str, coverage.Coverage]]:
    """The coverage distributions by name, a draw for each seed; the visited one comes last."""
    visited = learners.visited
    keys = jax.random.split(context.key, len(visited.reward))
    if normalisation.sensible(env.spec).all():
        draw = functools.partial(coverage.uniform, env=env, count=COMPARED, draws=DRAWS)
        yield "uniform", jax.jit(jax.vmap(draw))(keys)
    draw = functools.partial(coverage.visited, count=COMPARED, draws=DRAWS)
    yield "visited", jax.jit(jax.vmap(draw))(keys, visited)


def summarise(
    rows: pl.DataFrame, seeds: pl.DataFrame, measures: Mapping[str, str] = MEASURES
) -> pl.DataFrame:
    """The mean of each measure over the seeds of each cell, with its 95% interval.

    Args:
        rows: as `of_run` gives them, or others with a row for each learner; those of a column
            `physics` are told apart by it.
        seeds: the run's table, whose `expert_id` says which seeds share an expert.
        measures: the columns to summarise.
    """
    rows = with_experts(rows, seeds)
    labels = [name for name in ("method", "n_demos", "physics") if name in rows.columns]
    found = []
    for values, cell in rows.group_by(labels, maintain_order=True):
        experts = cell["expert_id"]
        for measure in measures:
            if measure not in cell.columns or cell[measure].null_count():
                continue
            interval = intervals.mean(
                cell[measure].to_numpy(),
                clusters=None if experts.null_count() else experts.to_numpy(),
            )
            found.append(
                {
                    **dict(zip(labels, values, strict=True)),
                    "measure": measure,
                    "seeds": cell.height,
                    "mean": interval.estimate,
                    "low": interval.low,
                    "high": interval.high,
                }
            )
    return pl.DataFrame(found)
