import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cmedirl_jax import tabular
from cmedirl_jax.tabular import SparseDynamics, Stop
from cmedirl_jax.tabular import dynamics as dynamics_lib
from tests.support import mdps


@given(st.integers(0, 1000), st.booleans())
def test_expectations_and_distributions_are_each_others_transpose(seed, sparse):
    dense, reward, _, _ = mdps.random_mdp(seed)
    values = np.random.default_rng(seed).normal(size=4)
    with jax.enable_x64(True):
        dynamics = mdps.sparse(dense) if sparse else dense
        expected = np.asarray(dynamics_lib.expected_next(dynamics, jnp.asarray(values)))
        arriving = np.asarray(dynamics_lib.next_distribution(dynamics, jnp.asarray(reward)))
    np.testing.assert_allclose(expected, dense @ values, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(arriving @ values, np.sum(reward * expected), rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize("shape", [(4, 2), (3, 3), (4,)])
def test_dynamics_of_other_sizes_are_refused(shape):
    dense, _, _, _ = mdps.random_mdp(0)
    for dynamics in (dense, mdps.sparse(dense)):
        dynamics_lib.check(dynamics, (4, 3))
        with pytest.raises(ValueError, match=r"expected a reward \[S, A\] and dynamics"):
            dynamics_lib.check(dynamics, shape)


NAN = float("nan")
TWO = np.array([[[0.25, 0.75], [1.0, 0.0]], [[0.0, 1.0], [0.5, 0.5]]], np.float32)
SUCCESSOR = np.tile(np.int32([0, 1]), (2, 2, 1))
ZEROS = np.zeros((2, 2), np.float32)
UNIFORM = tabular.SoftPolicy(np.full((2, 2), -np.log(2.0)), ZEROS, ZEROS[0], ZEROS[0, 0])


def fit(visitation, initial, **given):
    demonstrations = tabular.TabularDemonstrations(visitation, initial)
    return tabular.maxent_irl(demonstrations=demonstrations, **given)


START = {"initial": np.float32([1, 0])}
KNOWN = {"dynamics": TWO, "discount": 0.9}
soft = functools.partial(tabular.soft_value_iteration, reward=ZEROS, **KNOWN)
hard = functools.partial(tabular.value_iteration, reward=ZEROS, **KNOWN)
visits = functools.partial(tabular.expected_visitation, policy=UNIFORM, **START, **KNOWN)
irl = functools.partial(fit, np.float32([[10, 0], [0, 0]]), features=TWO, **START, **KNOWN)

ALL, SOLVERS = (soft, hard, visits, irl), (soft, hard)


@pytest.mark.parametrize(
    ("functions", "change", "message"),
    [
        (ALL, {"discount": 1.0}, "discount without a horizon must be .* below 1, got 1.0"),
        (ALL, {"discount": NAN}, "discount without a horizon must be .*, got nan"),
        (ALL, {"discount": 2.0, "horizon": 3}, "discount must be between 0 and 1, got 2.0"),
        (ALL, {"discount": -0.5, "horizon": 3}, "discount must be between 0 and 1, got -0.5"),
        (ALL, {"horizon": -1}, "horizon must be at least 1, got -1"),
        (ALL, {"dynamics": 2 * TWO}, "dynamics must be between 0 and 1, got 1.5 at"),
        (ALL, {"dynamics": TWO / 2}, "the sum of dynamics .* must be 1, got 0.5 at .0, 0"),
        (ALL, {"dynamics": TWO - 1}, "dynamics must be between 0 and 1, got -0.75"),
        (ALL, {"dynamics": TWO * NAN}, "dynamics must be between 0 and 1, got nan"),
        (
            ALL,
            {"dynamics": SparseDynamics(SUCCESSOR + 1, TWO)},
            r"next_state must be at least 0 and below 2, got 2 at \[0, 0, 1\]",
        ),
        (ALL, {"dynamics": SparseDynamics(SUCCESSOR, TWO + 1)}, "probability must be .*, got 1.25"),
        ((soft, irl), {"temperature": 0.0}, "temperature must be positive and finite, got 0.0"),
        ((soft, irl), {"temperature": -1}, "temperature must be positive and finite, got -1"),
        ((visits, irl), {"initial": np.float32([1, 1])}, "sum of initial .* must be 1, got 2.0"),
        ((visits, irl), {"initial": np.float32([2, -1])}, "initial must be between 0 .*, got 2.0"),
        (SOLVERS, {"reward": ZEROS + np.inf}, "reward must be finite or -inf, got inf"),
        (SOLVERS, {"reward": ZEROS * NAN}, "reward must be finite or -inf, got nan"),
        (SOLVERS, {"stop": Stop(tolerance=NAN)}, "tolerance must be at least 0 .*, got nan"),
        (SOLVERS, {"stop": Stop(iterations=0)}, "iterations must be at least 1, got 0"),
        ((soft, visits), {"guess": ZEROS[0] * NAN}, "guess must be finite, got nan"),
        ((irl,), {"features": NAN * TWO}, "features must be finite, got nan at .0, 0, 0"),
        ((irl,), {"prior_precision": -1.0}, "prior_precision must be at least 0 .*, got -1.0"),
    ],
)
def test_numbers_out_of_range_are_refused_with_the_value(functions, change, message):
    for function in functions:
        with pytest.raises(ValueError, match=message):
            function(**change)


def test_traced_numbers_pass():
    jax.eval_shape(soft, discount=2.0, temperature=-1.0, dynamics=2 * TWO, reward=ZEROS * NAN)


@pytest.mark.parametrize("horizon", [2.5, np.float32(2)])
def test_a_horizon_is_an_integer(horizon):
    with pytest.raises(TypeError, match="horizon: expected an integer, got 2"):
        soft(horizon=horizon)


def test_successors_of_probability_0_and_rows_of_absorbing_states_are_not_read():
    dense, reward, initial, ends = mdps.random_mdp(0, absorbing=True)
    padding = np.full((4, 3, 2), -1), np.zeros((4, 3, 2))
    successor, probability = map(np.array, mdps.sparse(dense))
    probability[ends] = 0.0
    padded = SparseDynamics(
        np.concatenate([successor, padding[0] * 99], axis=-1, dtype=np.int32),
        np.concatenate([probability, padding[1]], axis=-1),
    )
    with jax.enable_x64(True):
        solutions = []
        for dynamics in (dense, padded):
            given = {"discount": 0.9, "horizon": 4, "absorbing": ends}
            policy = tabular.soft_value_iteration(dynamics, jnp.asarray(reward), **given)
            mu = tabular.expected_visitation(dynamics, policy, jnp.asarray(initial), **given)
            solutions.append((policy.values, mu))
    for one, other in zip(*solutions, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12)
