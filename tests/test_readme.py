"""The commands and the code of README and docs are what they say they are."""

import re
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

README = Path(__file__).parents[1] / "README.md"
METHOD = README.parent / "docs" / "method.md"


def blocks(page):
    return re.findall(r"```python\n(.*?)```", page.read_text(), flags=re.DOTALL)


def test_the_quick_start_is_two_one_line_commands():
    quick_start = README.read_text().split("## Quick start")[1].split("\n## ")[0]
    commands = re.findall(r"```bash\n(.*?)```", quick_start, flags=re.DOTALL)
    assert len(commands) == 2
    assert all(command.count("\n") == 1 for command in commands)
    assert "python -m experiments.run_grid\n" in commands[0]
    assert "python -m pytest\n" in commands[1]


@pytest.mark.parametrize("code", [*blocks(README), *blocks(METHOD)])
def test_the_examples_run(code):
    names = {}
    exec(compile(code, "<example>", "exec"), names)
    arrays = [leaf for leaf in jax.tree.leaves(list(names.values())) if isinstance(leaf, jax.Array)]
    numbers = [leaf for leaf in arrays if jnp.issubdtype(leaf.dtype, jnp.floating)]
    assert numbers
    assert all(bool(jnp.isfinite(leaf).all()) for leaf in numbers)


def test_there_are_examples():
    assert len(blocks(README)) >= 2
    assert len(blocks(METHOD)) == 1
