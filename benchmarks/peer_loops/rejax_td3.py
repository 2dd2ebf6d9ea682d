"""TD3 of rejax on gymnax's environment; seeds are vmapped as in its documentation."""

import sys

import jax
from rejax import TD3

from benchmarks.serving import serve_from_command_line

algorithm = TD3.create(
    env="MountainCarContinuous-v0",
    buffer_size=12_000,
    fill_buffer=200,
    batch_size=32,
    num_envs=1,
    num_epochs=1,
    policy_delay=1,
    learning_rate=1e-3,
    polyak=0.99,
    target_update_freq=1,
    skip_initial_evaluation=True,
)
# Without its evaluation of 128 episodes: none of the loops here evaluates.
algorithm = algorithm.replace(eval_callback=lambda *_: ())


@jax.jit
def init(keys):
    """The training states of one learner per key."""
    return jax.vmap(algorithm.init_state)(keys)


states = init(jax.random.split(jax.random.PRNGKey(0), int(sys.argv[1])))
programs = {}


def advance(steps: int) -> None:
    """Take so many steps with every learner."""
    global states
    if steps not in programs:
        shorter = algorithm.replace(total_timesteps=steps, eval_freq=steps)
        programs[steps] = jax.jit(jax.vmap(lambda state: shorter.train(train_state=state)[0]))
    states = jax.block_until_ready(programs[steps](states))


serve_from_command_line(advance)
