import matplotlib.pyplot as plt
import numpy as np
import polars as pl
import pytest

from cmedirl_jax.runs import statistics
from cmedirl_jax.runs.report import curves, distributions, figures
from cmedirl_jax.training.methods import METHODS
from tests.support.cells import seeds_table

THRESHOLD = 90.0
STEPS = (0, 250, 500)
NEVER = (0.0, 10.0, 20.0)
LATE = (0.0, 10.0, 95.0)
AT_ONCE = (94.0, 80.0, 95.0)


@pytest.fixture(autouse=True)
def _close_figures():
    yield
    plt.close("all")


def draw(folder, cells, seeds=3, **options):
    """The files of all figures of a run."""
    evaluations, episodes, every_seed, summary = run(cells, seeds)
    # `figures.draw` looks up whose demonstrations a seed has.
    tables = {
        "evaluations": evaluations.drop("expert_id"),
        "episodes": episodes.drop("expert_id"),
        "seeds": every_seed,
    }
    return figures.draw(folder, tables, summary, THRESHOLD, **options)


def over(evaluations):
    return curves.over(evaluations, by_episodes=False)


def run(cells, seeds=3):
    """The tables and the summary of a run whose cells have these curves.

    Seed i returns i more than the curve and finishes i + 2 episodes.
    """
    evaluations = pl.DataFrame(
        [
            {
                "expert": "best" if n_demos else "none",
                "method": method,
                "n_demos": n_demos,
                "protocol": protocol,
                "seed": seed,
                "expert_id": seed,
                "env_step": env_step,
                "episode": env_step // 250,
                "return_mean": value + seed if protocol == "steps" else 1e6,
                "q_mean": 2.0 * env_step + seed if env_step else None,
                "critic_loss": 0.5 if env_step else None,
                "r_d_mean": None,
                "r_d_std": None,
            }
            for (method, n_demos), curve in cells.items()
            for protocol in ("episodes", "steps")
            for seed in range(seeds)
            for env_step, value in zip(STEPS, curve, strict=True)
            if env_step or protocol == "steps"
        ]
    )
    episodes = pl.DataFrame(
        [
            {
                "method": method,
                "n_demos": n_demos,
                "seed": seed,
                "episode": episode,
                "return": 10.0 * episode + seed,
                "expert_id": seed,
            }
            for method, n_demos in cells
            for seed in range(seeds)
            for episode in range(1, seed + 3)
        ]
    )
    per_seed = seeds_table(seeds)
    every_seed = pl.concat(
        per_seed.with_columns(method=pl.lit(method), n_demos=pl.lit(n_demos))
        for method, n_demos in cells
    )
    summary = pl.DataFrame(
        [
            statistics.summarise(
                evaluations.filter(pl.col("method") == method, pl.col("n_demos") == n_demos),
                per_seed,
                THRESHOLD,
                max_episodes=None,
            )
            for method, n_demos in cells
        ],
        infer_schema_length=None,
    )
    return evaluations, episodes, every_seed, summary


ALWAYS = ("figure3", "survival", "profile", "critic", "cost")
ONE_NUMBER = {("ddpg", 0): NEVER, ("hs-ddpg", 10): AT_ONCE}
TWO_NUMBERS = {
    ("ddpg", 0): LATE,
    ("hs-ddpg", 1): AT_ONCE,
    ("hs-ddpg", 10): AT_ONCE,
    ("me-ddpg", 1): NEVER,
    ("me-ddpg", 10): LATE,
}


@pytest.mark.parametrize("cells", [ONE_NUMBER, {("ddpg", 0): NEVER}])
def test_figures_4_and_5_need_several_numbers_of_demonstrations(cells, tmp_path):
    check_files(draw(tmp_path / "figures", cells), ALWAYS)


def check_files(paths, names):
    expected = {f"{name}.{suffix}" for name in names for suffix in ("png", "svg")}
    assert {path.name for path in paths} == expected
    assert {path.name for path in paths[0].parent.iterdir()} == expected
    for path in paths:
        assert path.read_bytes().startswith(b"\x89PNG" if path.suffix == ".png" else b"<?xml")


def test_the_same_tables_give_the_same_bytes(tmp_path):
    first, second = (draw(tmp_path / name, TWO_NUMBERS) for name in ("a", "b"))
    check_files(first, [*ALWAYS, "figure4", "figure5"])
    assert [path.read_bytes() for path in first] == [path.read_bytes() for path in second]


def test_cells_that_never_converged_can_be_drawn(tmp_path):
    cells = dict.fromkeys(TWO_NUMBERS, NEVER)
    paths = draw(tmp_path / "figures", cells, seeds=1)
    check_files(paths, [*ALWAYS, "figure4", "figure5"])


def test_figure_3_has_the_mean_of_the_seeds_over_steps():
    evaluations, episodes, _, _ = run({("ddpg", 0): LATE})
    left, _ = figures.average_return(over(evaluations), episodes, None, THRESHOLD).axes
    curve = left.lines[0]
    assert curve.get_label() == "DDPG"
    np.testing.assert_array_equal(curve.get_xdata(), STEPS)
    np.testing.assert_allclose(curve.get_ydata(), np.add(LATE, 1.0))


def test_figure_3_shows_the_largest_number_of_demonstrations_alone(tmp_path, monkeypatch):
    drawn = {}

    def average_return(evaluations, episodes, *_):
        drawn.update(evaluations=evaluations.rows, episodes=episodes)
        return plt.figure()

    def save(figure, files, say):
        return files[0].stem == "figure3" and bool(figure())

    monkeypatch.setattr(figures, "average_return", average_return)
    monkeypatch.setattr(figures.drawing, "save", save)
    draw(tmp_path / "figures", TWO_NUMBERS)
    for table in drawn.values():
        assert set(table["n_demos"]) == {0, 10}


def test_a_curve_over_episodes_stops_where_the_first_seed_runs_out():
    evaluations, episodes, _, _ = run({("ddpg", 0): LATE})
    _, right = figures.average_return(over(evaluations), episodes, None, THRESHOLD).axes
    curve = right.lines[0]
    np.testing.assert_array_equal(curve.get_xdata(), [1, 2])
    np.testing.assert_allclose(curve.get_ydata(), [11.0, 21.0])


def test_a_method_with_a_seed_that_finished_no_episode_has_no_curve_over_episodes():
    evaluations, episodes, _, _ = run({("ddpg", 0): LATE})
    episodes = episodes.filter(pl.col("seed") > 0)
    _, right = figures.average_return(over(evaluations), episodes, None, THRESHOLD).axes
    assert [line.get_label() for line in right.lines] == ["solved"]


def test_figure_4_leaves_out_what_never_converged():
    _, _, _, summary = run(TWO_NUMBERS)
    left, right = figures.convergence(summary).axes
    for axes, median in ((left, 2.0), (right, 500.0)):
        by_label = dict(zip(*reversed(axes.get_legend_handles_labels()), strict=True))
        np.testing.assert_array_equal(by_label["DDPG"].get_ydata(), [median] * 2)
        np.testing.assert_array_equal(by_label["ME-DDPG"][0].get_ydata(), [np.nan, median])
        np.testing.assert_array_equal(by_label["HS-DDPG"][0].get_ydata(), [0.0, 0.0])


def test_many_methods_have_a_panel_each():
    cells = {(method, 0): LATE for method in list(METHODS)[:6]}
    evaluations, episodes, _, _ = run(cells)
    figure = figures.average_return(over(evaluations), episodes, 94.0, THRESHOLD)
    titles = [axes.get_title() for axes in figure.axes if axes.get_title()]
    assert titles == [METHODS[method].label for method, _ in cells]
    assert [axes.axison for axes in figure.axes] == [True] * 6 + [False] * 2
    np.testing.assert_allclose(figure.axes[1].lines[1].get_ydata(), np.add(LATE, 1.0))


def test_a_run_over_episodes_is_drawn_over_episodes(tmp_path, monkeypatch):
    evaluations, episodes, _, _ = run({("ddpg", 0): LATE})
    by_episodes = curves.over(evaluations, by_episodes=True)
    left, _ = figures.average_return(by_episodes, episodes, None, THRESHOLD).axes
    np.testing.assert_array_equal(left.lines[0].get_xdata(), [0, 1, 2])
    np.testing.assert_allclose(left.lines[0].get_ydata()[1:], 1e6)
    assert left.get_xlabel() == "episodes"
    # Drawn, but not written.
    monkeypatch.setattr(figures.drawing, "save", lambda figure, files, say: bool(figure().axes))
    assert len(draw(tmp_path / "figures", ONE_NUMBER, by_episodes=True)) == 2 * len(ALWAYS)


def statistics_of(cells):
    evaluations, _, seeds, _ = run(cells)
    return distributions.of_methods(evaluations, seeds, THRESHOLD, by_episodes=False)


def test_survival_is_the_share_that_has_not_solved_the_task():
    found = statistics_of({("ddpg", 0): (0.0, 89.0, 95.0), ("hs-ddpg", 10): NEVER})
    (axes,) = distributions.survival(found, 500.0, by_episodes=False).axes
    ddpg, never = axes.lines
    # Seed i returns i more: the first solves it at step 500, the others at step 250.
    by_step = dict(zip(ddpg.get_xdata(), ddpg.get_ydata(), strict=True))
    assert by_step[250.0] == pytest.approx(1 / 3)
    assert by_step[500.0] == pytest.approx(0.0, abs=1e-12)
    assert set(never.get_ydata()) == {1.0}
    assert never.get_label().startswith("HS-DDPG, p = 0.0")
    (axes,) = distributions.survival(found, 2.0, by_episodes=True).axes
    assert max(axes.lines[0].get_xdata()) == 2.0


def test_a_profile_is_the_share_of_seeds_above_each_score():
    (axes,) = distributions.profile(statistics_of({("ddpg", 0): LATE})).axes
    scores, above = axes.lines[0].get_data()
    # The seeds return 35, 36 and 37 on average.
    np.testing.assert_allclose(scores, [34.0, 35.0, 36.0, 37.0, 37.0])
    np.testing.assert_allclose(above, [1.0, 2 / 3, 1 / 3, 0.0, 0.0])


@pytest.mark.parametrize(
    "draw", [lambda found: distributions.survival(found, 500.0, False), distributions.profile]
)
def test_many_methods_have_a_panel_each_beside_the_first(draw):
    found = statistics_of({(method, 0): LATE for method in list(METHODS)[:6]})
    figure = draw(found)
    titles = [axes.get_title().partition(",")[0] for axes in figure.axes if axes.get_title()]
    assert titles == [METHODS[method].label for method in found]
    assert [len(axes.lines) for axes in figure.axes] == [1, *[2] * 5, 0, 0]


def test_the_critics_values_and_losses_are_means_over_the_seeds():
    evaluations, _, _, _ = run({("ddpg", 0): LATE})
    values, losses = (axes.lines[0] for axes in figures.critic(over(evaluations)).axes)
    # Before the first update there are none.
    np.testing.assert_array_equal(values.get_xdata(), STEPS[1:])
    np.testing.assert_allclose(values.get_ydata(), 2.0 * np.array(STEPS[1:]) + 1.0)
    np.testing.assert_allclose(losses.get_ydata(), 0.5)


def test_all_steps_are_those_of_the_expert_and_the_demonstrations_too():
    evaluations, _, seeds, _ = run({("ddpg", 0): LATE, ("hs-ddpg", 10): AT_ONCE})
    free = seeds.with_columns(
        pl.when(pl.col("method") == "ddpg").then(0).otherwise(pl.col(name)).alias(name)
        for name in ("expert_steps", "demonstration_steps")
    )
    ddpg, hot, _ = figures.cost(evaluations, free, THRESHOLD).axes[0].lines
    np.testing.assert_array_equal(ddpg.get_xdata(), STEPS)
    np.testing.assert_array_equal(hot.get_xdata(), np.add(STEPS, 4_000 + 90))
