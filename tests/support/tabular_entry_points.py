"""What a user calls of `cm.tabular`, as `entry_points` has the rest."""

import functools

import jax
import jax.numpy as jnp
import numpy as np

import cmedirl_jax as cm
from cmedirl_jax.irl import IRLHParams
from tests.support import mdps
from tests.support.entry_points import DATA, ENV, PARAMS, SETTINGS, SPEC, SUBSET

DYNAMICS, TABLE, INITIAL, ABSORBING = mdps.random_mdp(0, 3, 2, absorbing=True)
DYNAMICS, TABLE, INITIAL = map(np.float32, (DYNAMICS, TABLE, INITIAL))


def control(dynamics, horizon, key, batch):
    del key
    known = {"discount": 0.5, "horizon": horizon, "absorbing": ABSORBING}
    table = jnp.asarray(TABLE) + batch.reward[0]
    policy = cm.tabular.soft_value_iteration(dynamics, table, **known)
    visits = cm.tabular.expected_visitation(dynamics, policy, INITIAL, **known)
    return policy, visits, cm.tabular.value_iteration(dynamics, table, **known)


def counted():
    state, action = np.int32([[0, 1], [1, 0]]), np.int32([[1, 0], [0, 0]])
    discount = np.float32(0.5)
    return cm.tabular.empirical_visitation(
        state, action, np.ones((2, 2), bool), (3, 2), discount=discount
    )


def maxent_irl(key, batch):
    del key
    features = jnp.asarray(np.eye(3, dtype=np.float32)) * batch.reward[0]
    known = {"discount": 0.5, "absorbing": ABSORBING}
    return cm.tabular.maxent_irl(DYNAMICS, features, counted(), **known, steps=2)


def deep_maxent_irl(key, batch):
    network = cm.rewards.mlp(SPEC, (3,), "state")
    inputs = batch.observation[:3], batch.action[:3]
    known = {"discount": 0.5, "horizon": 2}
    return cm.tabular.deep_maxent_irl(key, network, inputs, DYNAMICS, counted(), **known, steps=2)


def imitation(kind, key, batch):
    del batch
    settings = SETTINGS.tabular
    mdp = cm.tabular.imitation.discretised(ENV, settings)
    return cm.tabular.imitation.fit(key, mdp, SPEC, DATA, SUBSET, kind=kind, settings=settings)


def discretise(key, batch):
    mdp = cm.tabular.discretise.make(ENV, (3, 3), (2,), subsamples=2)
    random, keys = cm.tabular.discretise.sampled(mdp, ENV), jax.random.split(key)
    state, _ = random.reset(keys[0], PARAMS)
    taken = random.step(keys[1], state, batch.reward[:2], PARAMS)
    act = cm.tabular.discretise.greedy(mdp, mdp.reward)
    return mdp.dynamics, mdp.reward, taken, act(batch.observation)


def table_reward(key, batch):
    states, actions = cm.tabular.imitation.grids(SPEC, SETTINGS.tabular)
    made = cm.tabular.table_reward.make(states, actions)
    rising = jnp.linspace(0.0, 1.0, states.size * actions.size, dtype=jnp.float32)
    table = rising.reshape(states.size, actions.size) * batch.reward[0]
    visits = jnp.ones(states.size, jnp.float32)
    state = cm.tabular.table_reward.state(table, visits, 0.05, IRLHParams())
    return state, made.init(key), made.reward(state, batch.observation, batch.action)


_bind = functools.partial
_CONTROL = {
    "dense": (DYNAMICS, None),
    "sparse": (mdps.sparse(DYNAMICS), None),
    "horizon": (mdps.sparse(DYNAMICS), 2),
}

ENTRY_POINTS = {
    **{
        f"tabular control: {name}": functools.partial(control, *of) for name, of in _CONTROL.items()
    },
    "tabular.maxent_irl": maxent_irl,
    "tabular.deep_maxent_irl": deep_maxent_irl,
    **{
        f"tabular.imitation: {kind}": functools.partial(imitation, kind)
        for kind in ("linear", "deep")
    },
    "tabular.discretise": discretise,
    "tabular.table_reward": table_reward,
}
"""By name; the methods maxent-irl and deep-maxent-irl are imitation's."""
