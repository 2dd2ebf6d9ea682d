import contextlib
import os
import sys
import types

import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from cmedirl_jax.runs.console import compile_cache


@pytest.fixture
def configured():
    """JAX's configuration of its cache, as it was before the test."""
    names = (
        "jax_enable_compilation_cache",
        "jax_compilation_cache_dir",
        "jax_persistent_cache_min_compile_time_secs",
    )
    before = {name: getattr(jax.config, name) for name in names}
    jax.config.update("jax_enable_compilation_cache", True)
    compilation_cache.reset_cache()
    yield
    for name, value in before.items():
        jax.config.update(name, value)
    compilation_cache.reset_cache()


def compile_something():
    # A new function each time: nothing is found in the process itself.
    jax.jit(lambda x: jnp.sin(x) @ x)(jnp.ones((3, 3)))


def test_the_cost_counts_what_is_compiled_in_the_block_alone(configured, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compile_cache.use_cache()
    jax.block_until_ready(jnp.ones((3, 3)))
    with compile_cache.counted() as cost:
        assert (cost.seconds, cost.hits, cost.misses) == (0.0, 0, 0)
        compile_something()
        first = cost.seconds
        assert first > 0.0
        assert (cost.hits, cost.misses) == (0, 1)
        compile_something()
        assert (cost.hits, cost.misses) == (1, 1)
    after = cost.seconds
    compile_something()
    assert cost.seconds == after > first
    assert (cost.hits, cost.misses) == (1, 1)


def test_the_cache_lies_in_the_users_cache_folder(configured, tmp_path, monkeypatch):
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(
        compile_cache.platformdirs, "user_cache_path", lambda name, **_: tmp_path / name
    )
    compile_cache.use_cache()
    compile_something()
    assert any((tmp_path / "cmedirl_jax" / "compiled").iterdir())


@pytest.mark.parametrize("error", [RuntimeError("no home"), OSError("read-only")])
def test_a_user_without_a_home_has_no_cache(configured, monkeypatch, error):
    def user_cache_path(*_, **__):
        raise error

    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(compile_cache.platformdirs, "user_cache_path", user_cache_path)
    compile_cache.use_cache()
    assert jax.config.jax_compilation_cache_dir is None


def test_a_cache_that_cannot_be_written_is_not_used(configured, tmp_path, monkeypatch):
    jax.config.update("jax_compilation_cache_dir", None)
    (tmp_path / "file").touch()
    monkeypatch.setattr(
        compile_cache.platformdirs, "user_cache_path", lambda *_, **__: tmp_path / "file"
    )
    compile_cache.use_cache()
    assert jax.config.jax_compilation_cache_dir is None


def test_a_cache_that_jax_was_given_is_kept(configured, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compile_cache.use_cache()
    assert jax.config.jax_compilation_cache_dir == str(tmp_path)


@pytest.mark.parametrize("left", [0, 1, 40, -1])
def test_a_program_that_was_cut_short_on_disk_is_compiled_once_more(configured, tmp_path, left):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    compile_cache.use_cache()
    compile_something()
    (entry,) = tmp_path.glob("*-cache")
    entry.write_bytes(entry.read_bytes()[:left])
    # Without a warning, which would be an error here; and the next start finds it.
    for counts in ((0, 1), (1, 0)):
        compile_cache.use_cache()
        with compile_cache.counted() as cost:
            compile_something()
        assert (cost.hits, cost.misses) == counts


def test_entries_are_checked_once_and_those_of_other_programs_stay(
    configured, tmp_path, monkeypatch
):
    def refuse(entry):
        raise ValueError(entry)

    monkeypatch.setitem(sys.modules, "zstandard", types.SimpleNamespace(decompress=refuse))
    jax.config.update("jax_compilation_cache_dir", str(tmp_path))
    short = {"zlib-cache": b"\x78\x9cshort", "zstd-cache": b"\x28\xb5\x2f\xfdshort"}
    others = {"other-cache": b"another compressor's", "notes": b""}
    for name, content in (short | others).items():
        (tmp_path / name).write_bytes(content)
    compile_cache.use_cache()
    assert {path.name for path in tmp_path.iterdir()} == {*others, ".cmedirl_jax-checked"}
    # An old entry is not read again.
    (tmp_path / "zlib-cache").write_bytes(short["zlib-cache"])
    os.utime(tmp_path / "zlib-cache", (1.0, 1.0))
    compile_cache.use_cache()
    assert (tmp_path / "zlib-cache").exists()


@pytest.mark.parametrize("folder", ["", "gs://bucket/cache"])
def test_a_cache_that_is_no_folder_here_is_left_to_jax(configured, tmp_path, folder):
    jax.config.update("jax_compilation_cache_dir", folder)
    with contextlib.chdir(tmp_path):
        compile_cache.use_cache()
    assert not any(tmp_path.iterdir())
