"""What is said of a run's rewards beside their cards."""

from typing import NamedTuple

import flax.struct
import numpy as np
import polars as pl
import pytest

from cmedirl_jax import envs
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.report import (
    markup,
    retrained,
    reward_agreement,
    reward_cards,
    reward_diagnostics,
)
from cmedirl_jax.runs.report.reward_agreement import Agreement
from cmedirl_jax.runs.report.reward_samples import Learners
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings

CAR = envs.make("MountainCarContinuous-v0")
LABELS = {"method": "me-ddpg", "n_demos": 5}


def evaluations(returns, gaps):
    """Evaluations of four steps each; the first three say nothing of the end."""
    rows = []
    for seed, (last, gap) in enumerate(zip(returns, gaps, strict=True)):
        for step in range(4):
            at_end = step == 3
            learned = {"demonstration_reward": gap, "background_reward": 0.0}
            row = {"protocol": "steps", "seed": seed, "env_step": 10 * step}
            row |= {"return_mean": last if at_end else -99.0, "effective_sample_size": 3.0}
            rows.append(LABELS | row | {k: v if at_end else 7.0 for k, v in learned.items()})
    return pl.DataFrame(rows)


def test_a_diagnostic_is_ranked_with_the_return_at_the_end():
    returns, gaps = [10.0, 90.0, 50.0, 70.0, 30.0], [5.0, 1.0, 3.0, 2.5, 2.0]
    cards = pl.DataFrame({"seed": range(5), "auc": [0.5, 0.9, 0.7, 0.8, 0.6]})
    cards = cards.select(pl.lit("me-ddpg").alias("method"), pl.lit(5).alias("n_demos"), pl.all())
    learners = reward_diagnostics.of_learners(cards, evaluations(returns, gaps))
    assert learners["return"].to_list() == returns
    assert learners["gap"].to_list() == gaps
    found = reward_diagnostics.correlations(learners)
    # The effective sample size does not vary, and tells nothing.
    assert found.select("method", "diagnostic").rows() == [
        (method, name) for method in ("me-ddpg", "all") for name in ("gap", "auc")
    ]
    assert found["rank_correlation"].to_list() == pytest.approx([-0.7, 1.0] * 2)
    assert (found["low"] <= found["rank_correlation"]).all()
    assert (found["rank_correlation"] <= found["high"]).all()


def test_over_all_methods_learners_are_ranked_among_their_own():
    rows = [
        {"method": method, "n_demos": 5, "auc": base + i / 10, "return": base * 90 + sign * i}
        for method, base, sign in (("gail", 0.0, 1), ("me-ddpg", 1.0, -1))
        for i in range(6)
    ]
    found = reward_diagnostics.correlations(pl.DataFrame(rows))
    correlation = dict(found.select("method", "rank_correlation").rows())
    # Pooled as they are they would correlate by 0.5.
    assert correlation == pytest.approx({"gail": 1.0, "me-ddpg": -1.0, "all": 0.0})


def test_the_interval_covers_the_correlation_of_normal_pairs():
    rng, covered = np.random.default_rng(0), 0
    # Spearman's coefficient of normal pairs, by Pearson's of 0.5.
    true = 6.0 / np.pi * np.arcsin(0.25)
    for _ in range(300):
        x, noise = rng.normal(size=(2, 60))
        rows = pl.DataFrame({"auc": x, "return": 0.5 * x + np.sqrt(0.75) * noise})
        rows = rows.with_columns(method=pl.lit("gail"), n_demos=pl.lit(5))
        low, high = reward_diagnostics.correlations(rows).select("low", "high").row(0)
        covered += low <= true <= high
    assert 0.91 <= covered / 300 <= 0.99


def learners(seeds, method="gail"):
    """Learners whose rewards and steps do not matter."""
    return Learners(METHODS[method], 5, Settings(), np.array(seeds), *[None] * 4)


def test_disagreement_is_the_mean_distance_to_the_others():
    # The last reward is a constant, which is unrelated even to itself.
    distance = np.array([[0.0, 0.2, 0.7], [0.2, 0.0, 0.7], [0.7, 0.7, 0.7]])
    found = [Agreement(learners([4, 5, 9]), distance)]
    rows = reward_agreement.rows(found)
    assert rows["seed"].to_list() == [4, 5, 9]
    assert rows["disagreement"].to_list() == pytest.approx([0.45, 0.45, 0.7])
    assert len(reward_agreement.figure(found).axes) == 2
    alone = reward_agreement.rows([Agreement(learners([0]), np.zeros((1, 1)))])
    assert alone["disagreement"].to_list() == [None]


def test_agents_are_measured_at_the_end_against_those_on_the_tasks_reward():
    rows = [
        {"method": method, "n_demos": n_demos, "seed": seed, "physics": physics}
        | {"env_step": step, "return_mean": base + step + seed, "goal_fraction": 0.5}
        for method, n_demos, base in (("r_e", 0, 50.0), ("gail", 5, 20.0))
        for seed in range(2)
        for physics in ("own", "power=2")
        for step in range(5)
    ]
    agents = retrained.measured(pl.DataFrame(rows))
    assert agents.height == 8
    own = agents.filter(pl.col("physics") == "own").sort("method", "seed")
    assert own["return"].to_list() == [23.5, 24.5, 53.5, 54.5]
    assert own["regret"].to_list() == [30.0, 30.0, 0.0, 0.0]
    seeds = agents.select("method", "n_demos", "seed", expert_id=pl.lit(None, pl.Int32)).unique()
    summary = reward_cards.summarise(agents, seeds, retrained.MEASURES)
    assert summary.height == 2 * 2 * len(retrained.MEASURES)
    assert summary["seeds"].to_list() == [2] * summary.height
    figure = retrained.figure(pl.DataFrame(rows), seeds, 90.0)
    assert [axes.get_title() for axes in figure.axes] == ["own physics", "power=2"]


def planned(*changes, steps=120, env=CAR):
    return retrained.plan(env, steps, changes, [])


def test_physics_are_changed_by_name():
    physics = planned("power=0.001", "start_low=-0.9,start_high=-0.7,max_episode_steps=50").physics
    assert list(physics) == [
        "own",
        "power=0.001",
        "start_low=-0.9,start_high=-0.7,max_episode_steps=50",
    ]
    own, weak, short = physics.values()
    assert own == CAR.default_params
    assert weak == own.replace(power=0.001)
    assert short == own.replace(start_low=-0.9, start_high=-0.7, max_episode_steps=50)
    assert isinstance(short.max_episode_steps, int)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (("mass=2",), "mass=2 names none of the task's parameters: power, gravity"),
        (("power=much",), "power=much gives no number as 0.0015 is"),
        (("power=inf",), "power=inf is not finite"),
        (("max_episode_steps=1.5",), "gives no number as 999 is"),
        ((f"max_episode_steps={10**30}",), "gives no number as 999 is"),
    ],
)
def test_other_physics_are_refused(changes, said):
    with pytest.raises(UserError, match=f"--physics: .*{said}"):
        planned(*changes)


def test_what_cannot_be_retrained_is_refused():
    with pytest.raises(UserError, match="--retrain: 100 is no multiple of 8"):
        planned(steps=100)
    with pytest.raises(UserError, match="goal is no single number"):
        planned("goal=1", env=envs.make("PointMass-v0"))


def test_physics_of_any_dataclass_and_tuple():
    class Pair(NamedTuple):
        mass: float = 1.0
        heavy: bool = False

    @flax.struct.dataclass
    class Fields:
        mass: float = 1.0

    tasks = [CAR._replace(default_params=params) for params in (Pair(), Fields())]
    found = [planned("mass=2", env=env).physics["mass=2"].mass for env in tasks]
    assert found == [2.0, 2.0]
    with pytest.raises(UserError, match="heavy is no single number"):
        planned("heavy=True", env=tasks[0])
    with pytest.raises(UserError, match="parameters: none"):
        planned("mass=2", env=CAR._replace(default_params=()))


def test_a_learner_that_ended_early_is_judged_by_its_own_evaluations():
    table = evaluations([10.0, 20.0, 30.0, 40.0], [1.0, 2.0, 3.0, 4.0])
    early = pl.col("seed") == 0
    table = table.with_columns(
        env_step=pl.when(early).then(pl.col("env_step") // 10).otherwise(pl.col("env_step"))
    )
    cards = table.select("method", "n_demos", "seed").unique(maintain_order=True)
    found = reward_diagnostics.of_learners(cards, table)
    assert found["return"].to_list() == [10.0, 20.0, 30.0, 40.0]
    # A method without steps has one evaluation.
    table = table.filter(pl.col("env_step") == 0)
    assert reward_diagnostics.of_learners(cards, table)["return"].to_list() == [-99.0] * 4


def test_a_page_escapes_what_it_shows():
    cells = [markup.name("<a>", "b&c"), markup.interval([1.0, None, 2.0]), markup.interval([None])]
    page = markup.document(
        "<t>", [markup.table(["x<"], [cells]), "", markup.definitions({"<": ">"})]
    )
    assert "<title>&lt;t&gt;</title>" in page
    assert "&lt;a&gt;<small>b&amp;c</small>" in page
    assert "1.00<small>[?, 2.00]</small>" in page
    assert '<td class="number">-</td>' in page
    assert "<dt>&lt;</dt><dd>&gt;</dd>" in page
