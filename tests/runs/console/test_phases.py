import time

import jax
import jax.numpy as jnp
import pytest

from cmedirl_jax.runs.console import phases


def test_seconds_add_up_by_phase():
    with phases.counted() as spent:
        for _ in range(2):
            with phases.phase("training"):
                time.sleep(0.05)
        with phases.phase("saving"):
            time.sleep(0.01)
    assert list(spent) == ["training", "saving"]
    assert 0.1 <= spent["training"] < 0.3
    assert 0.01 <= spent["saving"] < 0.1


def test_compiling_is_left_out():
    def slow_to_compile(x):
        for n in range(60):
            x = jnp.sin(x) @ jnp.full((8, 8), n, x.dtype)
        return x

    x = jnp.ones((8, 8))
    began = time.perf_counter()
    with phases.counted() as spent, phases.phase("training"):
        jax.block_until_ready(jax.jit(slow_to_compile)(x))
    assert spent["training"] < 0.5 * (time.perf_counter() - began)


def test_nothing_is_counted_outside_or_after_a_failure():
    with phases.counted() as spent:
        pass
    with phases.phase("training"):
        pass
    with (
        phases.counted() as failed,
        pytest.raises(ValueError, match="told"),
        phases.phase("training"),
    ):
        raise ValueError("told")
    assert spent == failed == {}
