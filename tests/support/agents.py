"""A small agent on the car, random batches, and its float64 reference."""

import jax
import jax.numpy as jnp
import numpy as np

from cmedirl_jax import envs, networks
from cmedirl_jax.networks import Architecture
from cmedirl_jax.types import EnvSpec, Transition
from tests.support import reference

SPEC = envs.make("MountainCarContinuous-v0").spec
CENTRE, HALF_WIDTH = np.array([-0.3, 0.0]), np.array([0.9, 0.07])
ARCHITECTURE = Architecture(hidden=(5, 4), output_scale=0.5)
SMALL = networks.make(SPEC, ARCHITECTURE)


def random_batch(key, size, spec=SPEC):
    """Drawn by numpy, which compiles nothing."""
    rng = np.random.default_rng(np.asarray(jax.random.key_data(key)))
    low, high = spec.observation_low, spec.observation_high
    shape = (size, spec.observation_dim)
    batch = Transition(
        observation=rng.uniform(low, high, shape),
        action=rng.uniform(-1.0, 1.0, (size, spec.action_dim)),
        reward=rng.normal(size=size),
        next_observation=rng.uniform(low, high, shape),
        terminated=rng.random(size) < 0.3,
    )
    return jax.tree.map(
        lambda leaf: jnp.asarray(leaf if leaf.dtype == bool else leaf.astype(np.float32)), batch
    )


def scaled(observation):
    return (np.asarray(observation, np.float64) - CENTRE) / HALF_WIDTH


def reference_q(critic, observation, action):
    return reference.mlp(critic, scaled(observation), np.asarray(action), normalise=True)[:, 0]


def reference_pre_activation(actor, observation):
    return reference.mlp(actor, scaled(observation))


PROBE = EnvSpec(
    id="probe",
    observation_dim=1,
    action_dim=1,
    observation_low=np.array([-1.0], np.float32),
    observation_high=np.array([1.0], np.float32),
    action_low=np.array([-1.0], np.float32),
    action_high=np.array([1.0], np.float32),
    max_episode_steps=1,
    reward_threshold=0.0,
)
