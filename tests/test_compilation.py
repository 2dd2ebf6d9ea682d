import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cmedirl_jax as cm
from cmedirl_jax import compilation
from tests.support import compiling


@pytest.fixture
def options(monkeypatch):
    """What `jax.jit` is told."""
    monkeypatch.setattr(jax, "jit", lambda function, **options: options)
    monkeypatch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=false")
    return lambda: compilation.jit(jnp.sin, donate_argnums=0)


@pytest.mark.optimised
def test_less_is_optimised_on_a_cpu(options):
    level = {"xla_backend_optimization_level": 1}
    assert options() == {"donate_argnums": 0, "compiler_options": level}


@pytest.mark.optimised
def test_a_level_that_the_user_chose_stays(options, monkeypatch):
    monkeypatch.setenv("XLA_FLAGS", "--xla_backend_optimization_level=3")
    assert options() == {"donate_argnums": 0, "compiler_options": None}


def test_programs_that_jax_shall_not_optimise_stay_so(options):
    assert options()["compiler_options"] is None


@pytest.mark.optimised
def test_other_platforms_are_told_nothing(options, monkeypatch):
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert options()["compiler_options"] is None


@pytest.mark.optimised
def test_an_update_has_the_same_numbers(env):
    agent = cm.ddpg.make(env.spec)
    state = agent.init(jax.random.key(0))
    batch = cm.Transition(
        observation=jnp.linspace(-0.5, 0.4, 64, dtype=jnp.float32).reshape(32, 2),
        action=jnp.linspace(-1.0, 1.0, 32, dtype=jnp.float32)[:, None],
        reward=jnp.ones(32, jnp.float32),
        next_observation=jnp.linspace(-0.4, 0.5, 64, dtype=jnp.float32).reshape(32, 2),
        terminated=jnp.arange(32) == 3,
    )
    usual = compiling.jit_as_users(agent.update)(state, batch)
    level = {compilation._LEVEL: 1}
    less = compiling.jit_as_users(agent.update, compiler_options=level)(state, batch)
    jax.tree.map(functools.partial(np.testing.assert_allclose, rtol=1e-6, atol=1e-7), usual, less)
