"""The process that runs one workload: `python -m benchmarks.worker '{"method": "ddpg", ...}'`."""

import json
import os
import sys

import jax
import jax.numpy as jnp

from benchmarks import naive, ours
from benchmarks.serving import serve
from benchmarks.workload import Workload
from cmedirl_jax import envs
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.runs.cells import recording
from cmedirl_jax.runs.console import compile_cache


def demonstrations(episodes: int) -> Demonstrations:
    """Episodes of a scripted controller that solves the task, of about the length of DDPG's."""
    env = envs.make("MountainCarContinuous-v0")

    def act(actor: None, observation: jax.Array) -> jax.Array:
        return 0.8 * jnp.sign(observation[..., 1:])

    record = jax.jit(lambda key: recording.record(act, env, None, key, episodes))
    recorded = recording.flatten(*jax.device_get(record(jax.random.key(1))))
    return recording.joined([recorded], {"env": env.spec.id})


def main() -> None:
    """Serve the workload that the command line describes."""
    options = json.loads(sys.argv[1])
    steps = options.pop("steps")
    workload = Workload(**{**options, "hidden": tuple(options["hidden"])})
    jax.config.update("jax_num_cpu_devices", workload.devices)
    if "JAX_COMPILATION_CACHE_DIR" in os.environ:
        compile_cache.use_cache()
    variant = {"ours": ours, "naive": naive}[workload.variant]
    with compile_cache.counted() as cost:
        advance = variant.start(workload, demonstrations(workload.n_demos))
        serve(
            advance,
            steps,
            lambda: {"compile_seconds": cost.seconds, "platform": jax.default_backend()},
        )


if __name__ == "__main__":
    main()
