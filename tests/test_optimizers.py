import chex
import jax
import jax.numpy as jnp
import optax

from cmedirl_jax import optimizers

PARAMS = {"kernel": jnp.arange(6.0).reshape(2, 3), "bias": jnp.array([0.5])}


def gradient(step):
    return jax.tree.map(lambda x: jnp.cos(3.0 * x + step), PARAMS)


def trajectory(optimizer, **extra):
    params, state = PARAMS, optimizer.init(PARAMS)
    for step in range(5):
        updates, state = optimizer.update(gradient(step), state, params, **extra)
        params = optax.apply_updates(params, updates)
        yield params


def test_adam_is_optax_adam_step_for_step():
    ours = trajectory(optimizers.adam(), learning_rate=3e-3)
    theirs = trajectory(optax.adam(3e-3))
    for actual, expected in zip(ours, theirs, strict=True):
        chex.assert_trees_all_close(actual, expected, rtol=1e-6)


def test_learning_rates_can_be_vmapped_over():
    def last(learning_rate):
        *_, params = trajectory(optimizers.adam(), learning_rate=learning_rate)
        return params

    rates = [0.0, 1e-3, 1e-1]
    batched = jax.vmap(last)(jnp.array(rates))
    for index, rate in enumerate(rates):
        *_, expected = trajectory(optax.adam(rate))
        actual = jax.tree.map(lambda leaf, index=index: leaf[index], batched)
        chex.assert_trees_all_close(actual, expected, rtol=1e-5)


def test_without_a_learning_rate_nothing_moves():
    *_, params = trajectory(optimizers.adam())
    chex.assert_trees_all_equal(params, PARAMS)
