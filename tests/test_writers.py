"""Every file is written under another name and moved into place: none is ever half there."""

import ast

from tests.support import ROOT

WRITES = ("savefig", "write_bytes", "write_csv", "write_parquet", "write_text")
SAFE = ("replacing", "sealed")
"""The context managers of `io.atomic` and `runs.storage.sealing`, whose block writes elsewhere."""
SOURCES = [
    path
    for folder in ("cmedirl_jax", "experiments", "benchmarks")
    for path in sorted((ROOT / folder).rglob("*.py"))
]


def name(call):
    return getattr(call.func, "attr", getattr(call.func, "id", ""))


def writes(call):
    """Whether a call writes a file: none is a buffer in memory, or what keeps nothing."""
    if name(call) == "open" and "devnull" not in ast.dump(call):
        modes = [argument.value for argument in call.args if isinstance(argument, ast.Constant)]
        return any(str(mode)[:1] in ("w", "a", "x") for mode in modes)
    return name(call) in WRITES and call.args and getattr(call.args[0], "id", "") != "buffer"


def is_safe(block):
    """Whether what a block writes is moved into place afterwards."""
    if isinstance(block, ast.FunctionDef):
        return block.name in SAFE
    if not isinstance(block, ast.With):
        return False
    managers = [item.context_expr for item in block.items]
    return any(isinstance(manager, ast.Call) and name(manager) in SAFE for manager in managers)


def unsafe(tree):
    """The lines of a program that write a file in place."""
    safe = {node for block in ast.walk(tree) if is_safe(block) for node in ast.walk(block)}
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call) and node not in safe]
    return [call.lineno for call in calls if writes(call)]


def test_no_file_is_written_in_place():
    found = {str(path.relative_to(ROOT)): unsafe(ast.parse(path.read_text())) for path in SOURCES}
    assert {path: lines for path, lines in found.items() if lines} == {}


def test_the_writers_are_seen():
    assert unsafe(ast.parse("path.write_text('a')\nopen(path, 'w')\npath.open('rb')")) == [1, 2]
    assert (
        unsafe(ast.parse("with atomic.replacing(path) as partial:\n    f.savefig(partial)")) == []
    )
