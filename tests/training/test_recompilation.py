"""What the compiled training loop does with memory."""

import re
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from cmedirl_jax import training
from cmedirl_jax.agents import hot_start
from cmedirl_jax.training import seeds
from cmedirl_jax.training.methods import METHODS
from cmedirl_jax.training.settings import Settings
from tests.support import pools
from tests.support.compiling import jit_as_users

SEEDS, GROUP, CAPACITY = 4, 2, 10_000


@pytest.fixture(scope="module", params=["ddpg", "hs-me-ddpg"])
def compiled(request, env):
    """A method at its full size: its compiled training loop, its states and their data."""
    method = METHODS[request.param]
    data = hot_start.data(pools.scripted()) if method.uses_demonstrations else None
    trainer = training.make(env, method, Settings(), capacity=CAPACITY, subset_size=2)
    init = jax.vmap(trainer.init, in_axes=(0, None, None))
    shape = jax.eval_shape(init, seeds.keys(jax.random.key(0), SEEDS), data, 2)
    states = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), shape)
    run = jit_as_users(seeds.step_groups(trainer.run, GROUP), donate_argnums=0)
    arguments = (2, data, jnp.arange(200, 203), jnp.int32(10))
    # A donated buffer that cannot be used would be a warning.
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        return run.lower(states, *arguments).compile(), states, arguments


def size(states):
    leaves = [
        jax.random.key_data(x) if jnp.issubdtype(x.dtype, jax.dtypes.prng_key) else x
        for x in jax.tree.leaves(states)
    ]
    return sum(leaf.nbytes for leaf in leaves)


@pytest.mark.optimised
def test_the_states_are_overwritten_in_place(compiled):
    program, states, arguments = compiled
    assert program.memory_analysis().alias_size_in_bytes == size(states)
    donated = jax.tree.map(jnp.copy, states)
    after, _ = program(donated, *arguments)
    assert all(leaf.is_deleted() for leaf in jax.tree.leaves(donated))
    assert not any(leaf.is_deleted() for leaf in jax.tree.leaves(after))


@pytest.mark.optimised
def test_no_step_copies_the_replay(compiled):
    program, states, _ = compiled
    rows = ",".join(map(str, states.storage.shape[1:]))
    copies = re.findall(rf"= f32\[\d+,{rows}\]\S* copy\(.*", program.as_text())
    assert not copies


@pytest.mark.optimised
def test_a_seeds_state_takes_at_most_one_and_a_half_megabytes(compiled):
    _, states, _ = compiled
    assert states.storage.shape[1] == CAPACITY
    assert size(states) / SEEDS <= 1.5e6
    # The replay's rows are most of it, and they are stored once.
    assert size(states) / SEEDS <= 2.5 * np.prod(states.storage.shape[1:]) * 4
