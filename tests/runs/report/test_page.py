import html.parser

import polars as pl
import pytest

from cmedirl_jax.runs import statistics, validation
from cmedirl_jax.runs.config import StudyConfig
from cmedirl_jax.runs.report import page
from tests.support.cells import seeds_table

CONFIG = validation.describe(StudyConfig())
VERDICTS = "<h2>Verdicts</h2>"


@pytest.fixture(scope="module")
def summary():
    evaluations = pl.DataFrame(
        [
            {"method": "hs-ddpg", "n_demos": 5, "protocol": "steps", "seed": seed}
            | {
                "env_step": step,
                "episode": 1,
                "return_mean": 95.0,
                "r_d_mean": None,
                "r_d_std": None,
            }
            for seed in range(3)
            for step in (0, 250)
        ]
    )
    return pl.DataFrame([statistics.summarise(evaluations, seeds_table(3), 90.0, None)])


class Reader(html.parser.HTMLParser):
    """Notes tags that are not closed, what is shown, what is loaded and what is linked."""

    def __init__(self):
        super().__init__()
        self.open, self.shown, self.loaded, self.linked = [], [], [], []

    def handle_starttag(self, tag, attrs):
        if tag not in ("meta", "img"):
            self.open.append(tag)
        to = self.linked if tag == "a" else self.loaded
        to += [value for name, value in attrs if name in ("src", "href")]

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        self.shown.append(data)


def read(text):
    reader = Reader()
    reader.feed(text)
    assert reader.open == []
    return reader


def test_the_page_shows_verdicts_results_and_figures(summary, tmp_path):
    picture = tmp_path / "figure3.png"
    picture.write_bytes(b"abc")
    text = page.page(CONFIG, summary, 90.0, {"figure3": picture}, {"jax": "1.2"}, verdicts=VERDICTS)
    reader = read(text)
    shown = " ".join(reader.shown)
    for line in ("Verdicts", "jax 1.2", "Solved: a mean return of 90 at"):
        assert line in shown
    assert "hs-ddpg (N_T 5)" in shown
    assert "[0.29, 1.00]" in shown
    assert reader.loaded == ["data:image/png;base64,YWJj"]


def test_the_page_loads_nothing_and_runs_nothing(summary, tmp_path):
    text = page.page(CONFIG, summary, 90.0, {}, {})
    assert "<script" not in text
    assert "http" not in text


def test_the_page_of_learned_rewards_is_linked(summary):
    assert read(page.page(CONFIG, summary, 90.0, {}, {})).linked == ["reward/report.html"]
    without = CONFIG | {"methods": ["ddpg", "hs-ddpg"]}
    assert read(page.page(without, summary, 90.0, {}, {})).linked == []


def test_a_run_over_episodes_is_told_in_episodes(summary):
    config = CONFIG | {"max_steps": None, "max_episodes": 30}
    shown = " ".join(read(page.page(config, summary, 90.0, {}, {}, by_episodes=True)).shown)
    assert "30 episodes each" in shown
    assert "episodes to solve, median" in shown
    assert "steps to solve" not in shown


def test_without_verdicts_or_figures_there_is_still_a_page(summary, tmp_path):
    gone = {"figure3": tmp_path / "gone.png"}
    reader = read(page.page(CONFIG, summary, 90.0, gone, {}))
    assert reader.loaded == []
    assert "Verdicts" not in reader.shown


def test_the_page_does_not_say_where_the_run_lies(summary):
    config = CONFIG | {"out": "/somewhere/else"}
    assert "/somewhere" not in page.page(config, summary, 90.0, {}, {})
