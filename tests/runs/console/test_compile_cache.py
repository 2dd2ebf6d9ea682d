import jax
import jax.numpy as jnp
import pytest
from jax.experimental.compilation_cache import compilation_cache

from cmedirl_jax.runs.console import compile_cache


@pytest.fixture
def configured():
    """JAX's configuration of its cache, as it was before the test."""
    names = ("jax_compilation_cache_dir", "jax_persistent_cache_min_compile_time_secs")
    before = {name: getattr(jax.config, name) for name in names}
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
