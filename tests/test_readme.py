"""The commands and the code of README and docs are what they say they are."""

import functools
import json
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
README = ROOT / "README.md"
RESULTS = ROOT / "docs" / "results"
PAGES = [README, *sorted((ROOT / "docs").glob("*.md"))]
NOTEBOOK = ROOT / "docs" / "notebook.ipynb"
OTHER_PAGES = [
    *(ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", ROOT / "docs/results/README.md"),
    NOTEBOOK,
]
LINK = re.compile(r"\]\(([^)#\s]+\.\w+)[)#]")
TEST = re.compile(r"(?<=[`/ ])(?:test_|\.\.\._)[a-z][\w.]*(?=`|: )")
PATH = re.compile(r"`((?:cmedirl_jax|experiments|benchmarks|tests|docs)/[\w./-]*)`")


def blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)


@functools.cache
def run(code):
    names = {}
    exec(compile(code, "<example>", "exec"), names)
    return names


EXAMPLES = [
    pytest.param(code, id=f"{page.stem}-{number}")
    for page in PAGES
    for number, code in enumerate(blocks(page))
]


def test_the_quick_start_is_two_one_line_commands():
    quick_start = README.read_text().split("## Quick start")[1].split("\n## ")[0]
    commands = re.findall(r"```bash\n(.*?)```", quick_start, flags=re.DOTALL)
    assert len(commands) == 2
    assert all(command.count("\n") == 1 for command in commands)
    assert "python -m experiments.run_grid\n" in commands[0]
    assert "python -m pytest\n" in commands[1]


def test_readme_is_a_front_page():
    lines = README.read_text().splitlines()
    assert len(lines) <= 130
    assert lines.index("```python") <= 50


@pytest.mark.parametrize("code", EXAMPLES)
def test_the_examples_run(code, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = run(code)
    arrays = [leaf for leaf in jax.tree.leaves(list(names.values())) if isinstance(leaf, jax.Array)]
    numbers = [leaf for leaf in arrays if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert numbers
    assert all(np.isfinite(np.asarray(leaf)).all() for leaf in numbers)


def test_readmes_reward_prefers_what_the_demonstrator_does():
    names = run(blocks(README)[0])
    learner, state, shown = names["learner"], names["state"], names["shown"]
    reward = jax.jit(learner.reward)
    demonstrated = np.asarray(reward(state, shown.observation, shown.action))
    opposite = np.asarray(reward(state, shown.observation, -np.asarray(shown.action)))
    assert np.mean(demonstrated > opposite) > 0.95
    assert names["info"].demonstration_reward[-1] > names["info"].background_reward[-1] + 0.05


def test_no_result_names_a_path_of_some_machine():
    results = [path for kind in ("json", "csv", "md", "txt") for path in RESULTS.rglob(f"*.{kind}")]
    assert len(results) > 50
    absolute = re.compile(r"(?<![\w.)\]/:*-])/(?:tmp|home|root|work|Users|var|mnt)/")
    assert [path for path in results if absolute.search(path.read_text())] == []


def test_there_are_examples():
    assert len(blocks(README)) == 1
    assert len(EXAMPLES) >= 6


@pytest.mark.parametrize("page", [*PAGES, *OTHER_PAGES], ids=lambda page: page.stem)
def test_links_and_paths_lead_somewhere(page):
    text = page.read_text()
    linked = [page.parent / link for link in LINK.findall(text) if "://" not in link]
    named = [ROOT / path for path in PATH.findall(text)]
    assert [path for path in linked + named if not path.exists()] == []


def test_the_notebook_holds_the_outputs_of_one_run_from_top_to_bottom():
    cells = [
        cell for cell in json.loads(NOTEBOOK.read_text())["cells"] if cell["cell_type"] == "code"
    ]
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    kinds = {output["output_type"] for cell in cells for output in cell["outputs"]}
    assert kinds == {"stream", "display_data"}
    assert NOTEBOOK.stat().st_size < 300_000


def test_tests_that_are_named_exist():
    """By a file's or a function's name, of which three points leave out the middle or an end."""
    files = list((ROOT / "tests").rglob("test_*.py"))
    there = {path.stem for path in files} | {path.name for path in files}
    for path in files:
        there.update(re.findall(r"def (test_\w+)", path.read_text()))
    named = {name for page in PAGES for name in TEST.findall(page.read_text())}
    patterns = {name: re.escape(name).replace(r"\.\.\.", r"\w*") for name in named}
    assert len(named) > 40
    missing = {
        name for name, what in patterns.items() if not any(map(re.compile(what).fullmatch, there))
    }
    assert missing == set()
