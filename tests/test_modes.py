"""Modes of the program that embeds the library x what it calls (the table of `docs/embedding.md`).

Types, ranks, keys and transformations are matters of tracing: nothing of that is compiled.
"""

import contextlib

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import cmedirl_jax as cm
from tests.support import entry_points, tabular_entry_points
from tests.support.entry_points import BATCH, POOL, SETTINGS

ENTRY_POINTS = entry_points.ENTRY_POINTS | tabular_entry_points.ENTRY_POINTS

ALIKE_IN_TYPES = {
    *("training: hs-ddpg", "training: me-ddpg", "training: irl-only", "training.fit"),
    *("training: ddpg-plus-constant", "training: ddpg-minus-constant"),
}
"""Those whose parts the other rows of training have."""

TAKES_DATA = (
    *("envs", "replay", "ddpg: switches", "exploration: noisy", "irl: absorbing, gauge, penalty"),
    *("background: recorded, visitation", "evaluation", "tabular.table_reward"),
    *("tabular control: dense", "tabular control: horizon"),
)
"""Those that pass the caller's floats on to a state or a loop."""

WITH_A_LOOP_OR_A_BRANCH = {
    *("ddpg: switches", "exploration: noisy", "irl: absorbing, gauge, penalty", "evaluation"),
    *("seeds", "tabular control: dense", "tabular.maxent_irl", "training: gail"),
}
"""One for each loop and branch that `shard_map` has to be told of."""

NOT_IN_SHARD_MAP = {"tabular.maxent_irl"}
"""Its default optimiser is optax's L-BFGS, which has constants in its branches."""

CHEAP_TO_RUN = {"shaping", "schedules", "tabular control: horizon"}

NAN_IN_PASSING = {"tabular.maxent_irl"}
"""optax's line search divides zero by zero where it does not look."""

DIFFERENTIABLE = ("envs", "networks: layer", "shaping", "tabular control: horizon")


def table(*, quick):
    """Every entry point; those that are not quick only with -m slow."""
    return [
        pytest.param(name, marks=() if name in quick else pytest.mark.slow) for name in ENTRY_POINTS
    ]


def unless(refused, error):
    return pytest.raises(type(error), match=str(error)) if refused else contextlib.nullcontext()


@contextlib.contextmanager
def modes(*of):
    with contextlib.ExitStack() as stack:
        for mode in of:
            stack.enter_context(mode)
        yield


@pytest.mark.parametrize("name", table(quick=ENTRY_POINTS.keys() - ALIKE_IN_TYPES))
def test_x64_strict_ranks_no_key_twice_and_another_generator(name):
    with modes(
        jax.enable_x64(True),
        jax.numpy_rank_promotion("raise"),
        jax.debug_key_reuse(True),
        jax.default_prng_impl("rbg"),
    ):
        key = jax.random.key(1)
        result = jax.eval_shape(ENTRY_POINTS[name], key, BATCH)
    dtypes = {leaf.dtype for leaf in jax.tree.leaves(result)}
    # Typed keys are the caller's; all else has 32 bits, as without x64.
    assert dtypes <= {key.dtype, *map(np.dtype, ("float32", "int32", "uint32", "bool"))}


@pytest.mark.parametrize("name", TAKES_DATA)
def test_data_of_64_bits(name):
    wide = jax.tree.map(lambda leaf: leaf if leaf.dtype == bool else np.float64(leaf), BATCH)
    with jax.enable_x64(True):
        assert jax.tree.leaves(jax.eval_shape(ENTRY_POINTS[name], jax.random.key(1), wide))


def transformed(function):
    """`function` within vmap, within scan, within shard_map over two devices, within jit."""

    def scanned(*given):
        return jax.lax.scan(lambda _, each: (None, jax.vmap(function)(*each)), None, given)[1]

    automatic = (jax.sharding.AxisType.Auto,)
    split, mesh = jax.P(None, "seeds"), jax.sharding.AbstractMesh((2,), ("seeds",), automatic)
    return jax.jit(jax.shard_map(scanned, mesh=mesh, in_specs=split, out_specs=split))


@pytest.mark.parametrize("name", table(quick=WITH_A_LOOP_OR_A_BRANCH))
def test_within_vmap_scan_shard_map_and_jit(name):
    batch = jax.tree.map(lambda leaf: np.stack([leaf, leaf])[None], BATCH)
    refusal = unless(name in NOT_IN_SHARD_MAP, TypeError("manual axis types do not match"))
    with jax.default_prng_impl("unsafe_rbg"), refusal:
        keys = jax.random.split(jax.random.key(1), (1, 2))
        result = jax.eval_shape(transformed(ENTRY_POINTS[name]), keys, batch)
        assert {leaf.shape[:2] for leaf in jax.tree.leaves(result)} == {(1, 2)}


def floats(tree):
    return [leaf for leaf in jax.tree.leaves(tree) if jnp.issubdtype(leaf.dtype, jnp.floating)]


def gradient(function, given):
    """The gradient of the sum of a result's floats by those of the batch."""

    def total(given):
        result = function(jax.random.key(1), BATCH._replace(**given))
        return sum(jnp.sum(leaf) for leaf in floats(result))

    return jax.grad(total)(given)


FLOATS = {name: getattr(BATCH, name) for name in ("observation", "action", "reward")}


@pytest.mark.parametrize("name", DIFFERENTIABLE)
def test_within_grad(name):
    result = jax.eval_shape(lambda given: gradient(ENTRY_POINTS[name], given), FLOATS)
    assert {name: leaf.shape for name, leaf in result.items()} == {
        name: leaf.shape for name, leaf in FLOATS.items()
    }


def test_an_evaluation_ends_with_its_last_episode_and_so_has_no_gradient():
    with pytest.raises(ValueError, match=r"not work for lax\.while_loop"):
        jax.eval_shape(lambda given: gradient(ENTRY_POINTS["evaluation"], given), FLOATS)


@pytest.mark.parametrize("name", table(quick=CHEAP_TO_RUN))
def test_without_jit_and_where_a_nan_is_an_error(name):
    refusal = unless(name in NAN_IN_PASSING, FloatingPointError("nan"))
    with (
        modes(jax.disable_jit(), jax.debug_nans(True), jax.default_prng_impl("rbg")),
        refusal,
    ):
        result = ENTRY_POINTS[name](jax.random.key(1), BATCH)
        assert not any(np.isnan(leaf).any() for leaf in jax.tree.leaves(floats(result)))


def test_x64_and_vmap_give_the_numbers_that_one_call_gives():
    function = ENTRY_POINTS["exploration: epsilon-greedy"]
    keys = jax.random.split(jax.random.key(1))
    one = jax.jit(function)
    expected = [one(key, BATCH) for key in keys]
    together = jax.device_get(jax.jit(jax.vmap(function, in_axes=(0, None)))(keys, BATCH))
    for i, single in enumerate(expected):
        found = jax.tree.map(lambda leaf, i=i: leaf[i], together)
        chex.assert_trees_all_close(found, single, rtol=1e-5, atol=1e-6)
    with jax.enable_x64(True):
        chex.assert_trees_all_close(one(keys[0], BATCH), expected[0], rtol=1e-5, atol=1e-6)


def test_jaxs_checker_of_keys_refuses_seeds_of_a_scan_over_keys_as_hot_starts_are():
    def plain(key):
        return jax.lax.scan(
            lambda _, key: (None, jax.random.normal(key)), None, jax.random.split(key)
        )

    hot_start = ENTRY_POINTS["hot_start: monte-carlo"]
    for function in (plain, lambda key: hot_start(key, BATCH)):
        with jax.debug_key_reuse(True), pytest.raises(jax.errors.KeyReuseError):
            jax.eval_shape(jax.vmap(function), jax.random.split(jax.random.key(1)))


@pytest.mark.parametrize(
    "call",
    [
        cm.demonstrations.episodes,
        cm.demonstrations.validate,
        cm.hot_start.data,
        lambda pool: cm.demonstrations.subset(jax.random.key(0), pool, 1),
        lambda pool: cm.training.fit(
            jax.random.key(0), entry_points.ENV, "bc", pool, seeds=2, steps=250, settings=SETTINGS
        ),
    ],
    ids=["episodes", "validate", "hot_start.data", "subset", "fit"],
)
def test_what_works_on_the_host_names_the_traced_argument(call):
    def traced(transition, episode):
        return call(POOL._replace(transition=transition, episode=episode))

    with pytest.raises(jax.errors.TracerArrayConversionError, match="of the argument"):
        jax.eval_shape(traced, POOL.transition, POOL.episode)
