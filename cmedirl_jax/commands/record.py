"""Record demonstrations of a policy that a run has learned, or of any Python function.

Example: cmedirl demos record pool.npz --run results/tuned --method hs-me-ddpg --seed 3
Example: cmedirl demos record pool.npz --env Pendulum-v1 --policy my_module:my_policy
"""

import contextlib
import dataclasses
import importlib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import jax
import numpy as np
import tyro

from cmedirl_jax import envs
from cmedirl_jax.commands import convert, sources
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv, playing
from cmedirl_jax.ranges import Count, Size
from cmedirl_jax.runs.cells import recording
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.errors import UserError


@dataclasses.dataclass(frozen=True)
class Options:
    """Who demonstrates, and where it is written.

    Attributes:
        out: A file that ends in .npz, .csv or .parquet, or the id of a new dataset of Minari's.
        run: A run's folder, whose policy demonstrates.
        method: Of the run, where it has several.
        seed: Which of its learners.
        n_demos: Demonstrations of the learner, where the run has several numbers of them.
        env: The task, where a function demonstrates.
        policy: A function `(observation [O]) -> action [A]`, as MODULE:FUNCTION.
        episodes: How many.
        reset_seed: Of the first episode's start; the others follow it.
    """

    out: Annotated[str, tyro.conf.Positional]
    run: str | None = None
    method: str | None = None
    seed: Count = 0
    n_demos: Size | None = None
    env: str | None = None
    policy: str | None = None
    episodes: Size = 10
    reset_seed: Count = 0


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    convert.check_target(options.out)
    name, act, source = _demonstrator(options)
    env = sources.task(name)
    pool = record(env, act, options.episodes, options.reset_seed, source)
    try:
        demonstrations.validate(pool, env.spec)
    except ValueError as error:
        raise UserError(f"{source}: {error}") from error
    convert.write(options.out, pool, env.spec)
    returns = demonstrations.returns(pool)
    spread = f"{returns.mean():.4g} ± {returns.std():.2g}"
    screen.say(screen.console(), f"{options.out}: {len(returns)} episodes, returns {spread}")
    return 0


def _demonstrator(options: Options) -> tuple[str, Callable[[np.ndarray], Any], str]:
    """The task's name, the policy of one observation, and where it comes from."""
    if (options.run is None) == (options.policy is None):
        raise UserError("give either --run, or --policy and --env")
    if options.run is not None:
        policy = sources.policy(Path(options.run), options.method, options.seed, options.n_demos)
        source = f"{policy.method}, seed {options.seed}, of {options.run}"
        return policy.task, jax.jit(policy.act), source
    if options.env is None:
        raise UserError("--env: name the task that --policy acts in")
    assert options.policy is not None
    module, _, function = options.policy.partition(":")
    try:
        return options.env, getattr(importlib.import_module(module), function), options.policy
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"--policy: {options.policy} is no MODULE:FUNCTION ({error})") from error


def record(
    env: Env | HostEnv,
    act: Callable[[np.ndarray], Any],
    episodes: int,
    reset_seed: int,
    source: str,
) -> Demonstrations:
    """Record episodes of a policy, one after the other, from the starts of consecutive seeds.

    Args:
        env: the task.
        act: `(observation [O]) -> action [A]`.
        episodes: how many.
        reset_seed: of the first one's start.
        source: what the metadata say of who acts.
    """
    host = env if isinstance(env, HostEnv) else envs.from_gymnasium(lambda: envs.to_gymnasium(env))
    seeds = np.arange(reset_seed, reset_seed + episodes)

    def act_all(observations: np.ndarray) -> np.ndarray:
        return np.stack([np.asarray(act(observation), np.float32) for observation in observations])

    with contextlib.closing(host.vector(1)) as vector:
        (pool,) = recording.of_steps(
            playing.play(vector, act_all, seeds[None], env.spec.max_episode_steps)
        )
    metadata = {"env": env.spec.id, "source": source, "seeds": seeds.tolist()}
    return recording.joined([pool], metadata)
