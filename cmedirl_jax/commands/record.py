"""Record demonstrations of what a run has learned, or of any Python function.

Example: cmedirl demos record pool.npz --run results/tuned --method hs-me-ddpg --seed 3
Example: cmedirl demos record mine/car/medium-v0 --run results/car --quality medium
Example: cmedirl demos record pool.npz --env Pendulum-v1 --policy my_module:my_policy
"""

import contextlib
import dataclasses
import importlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tyro

from cmedirl_jax import envs
from cmedirl_jax.commands import convert, demonstrators, sources
from cmedirl_jax.commands.demonstrators import Demonstrators, Quality
from cmedirl_jax.data import demonstrations
from cmedirl_jax.data.demonstrations import Demonstrations
from cmedirl_jax.envs import Env, HostEnv, playing
from cmedirl_jax.ranges import FINITE, Count, Size
from cmedirl_jax.runs.cells import recording
from cmedirl_jax.runs.console import screen
from cmedirl_jax.runs.errors import UserError


@dataclasses.dataclass(frozen=True)
class Options:
    """Who demonstrates, and where it is written.

    Attributes:
        out: A file that ends in .npz, .csv or .parquet, or the id of a new dataset of Minari's.
        run: A run's folder, whose policies demonstrate.
        method: Of the run, where it has several.
        seed: Which of its learners; default 0.
        quality: Of the learners' policies, in place of a seed. expert: the best one; medium: the
            one whose return lies nearest to half way from random actions to the expert's; mixed:
            all of them in turn.
        ref_max_score: The expert's return, where another run has the expert; default that of the
            run's best policy.
        n_demos: Demonstrations of the learner, where the run has several numbers of them.
        env: The task, where a function demonstrates.
        policy: A function `(observation [O]) -> action [A]`, as MODULE:FUNCTION.
        episodes: How many.
        reset_seed: Of the first episode's start; the others follow it.
        author: What a dataset of Minari's says of its author.
        author_email: And of how to reach them.
        code_permalink: And of the code that made it.
    """

    out: Annotated[str, tyro.conf.Positional]
    run: Path | None = None
    method: str | None = None
    seed: Count | None = None
    quality: Quality | None = None
    ref_max_score: Annotated[float, FINITE] | None = None
    n_demos: Size | None = None
    env: str | None = None
    policy: str | None = None
    episodes: Size = 10
    reset_seed: Count = 0
    author: str | None = None
    author_email: str | None = None
    code_permalink: str | None = None


def run(options: Options) -> int:
    """Run the command; returns its exit code."""
    convert.check_target(options.out)
    _check(options)
    who = _of_run(options) if options.run is not None else _of_function(options)
    env = sources.task(who.task)
    pool = record(env, who.policies, options.episodes, options.reset_seed)
    facts = {name: getattr(options, name) for name in ("author", "author_email", "code_permalink")}
    known = {name: value for name, value in facts.items() if value is not None}
    pool = pool._replace(metadata={**pool.metadata, **who.metadata, **known})
    try:
        demonstrations.validate(pool, env.spec)
    except ValueError as error:
        raise UserError(f"{who.metadata['source']}: {error}") from error
    pool = pool._replace(
        metadata={**pool.metadata, "description": demonstrators.datasheet(pool, env.spec)}
    )
    convert.write(options.out, pool, env.spec)
    returns = demonstrations.returns(pool)
    said = f"{options.out}: {len(returns)} episodes, returns {sources.spread(returns)}"
    screen.say(screen.console(), said)
    return 0


def _check(options: Options) -> None:
    """Refuse options that contradict each other, or that say nothing to the others."""
    if (options.run is None) == (options.policy is None):
        raise UserError("give either --run, or --policy and --env")
    if options.policy is not None and options.env is None:
        raise UserError("--env: name the task that --policy acts in")
    others = ("method", "seed", "quality", "n_demos", "ref_max_score")
    for name in others if options.policy is not None else ("env",):
        if getattr(options, name) is not None:
            other = "policy" if options.policy is not None else "run"
            raise UserError(f"--{name.replace('_', '-')}: says nothing beside --{other}")
    if options.quality is not None and options.seed is not None:
        raise UserError("--seed: says nothing beside --quality")
    if options.quality is None and options.ref_max_score is not None:
        raise UserError("--ref-max-score: says nothing without --quality")


def _of_run(options: Options) -> Demonstrators:
    assert options.run is not None
    seed = options.seed or 0
    one = sources.policy(options.run, options.method, seed, options.n_demos)
    if options.quality is None:
        return demonstrators.of_seed(options.run, one, seed)
    return demonstrators.of_quality(
        options.run,
        one,
        options.n_demos,
        options.quality,
        options.episodes,
        options.ref_max_score,
    )


def _of_function(options: Options) -> Demonstrators:
    assert options.env is not None
    assert options.policy is not None
    module, _, function = options.policy.partition(":")
    try:
        act = getattr(importlib.import_module(module), function)
    except (ImportError, AttributeError, ValueError) as error:
        raise UserError(f"--policy: {options.policy} is no MODULE:FUNCTION ({error})") from error
    source = {"source": options.policy, "algorithm_name": options.policy}
    return Demonstrators(options.env, [act], source)


def record(
    env: Env | HostEnv,
    policies: Sequence[Callable[[np.ndarray], Any]],
    episodes: int,
    reset_seed: int,
) -> Demonstrations:
    """Record episodes of policies in turn, from the starts of consecutive seeds.

    A task that is a copy of Gymnasium's is played in Gymnasium's, where the seeds mean the same.

    Args:
        env: the task.
        policies: `(observation [O]) -> action [A]`.
        episodes: how many, of all policies together.
        reset_seed: of the first one's start.
    """
    host = _on_host(env)
    seeds = np.arange(reset_seed, reset_seed + episodes)

    def episode(vector: Any, index: int) -> Demonstrations:
        act = policies[index % len(policies)]

        def act_all(observations: np.ndarray) -> np.ndarray:
            return np.stack([np.asarray(act(seen), np.float32) for seen in observations])

        limit = env.spec.max_episode_steps
        (pool,) = recording.of_steps(
            playing.play(vector, act_all, seeds[None, index : index + 1], limit)
        )
        return pool

    with contextlib.closing(host.vector(1)) as vector:
        pools = [episode(vector, index) for index in range(episodes)]
    return recording.joined(pools, {"env": env.spec.id, "seeds": seeds.tolist()})


def _on_host(env: Env | HostEnv) -> HostEnv:
    if isinstance(env, HostEnv):
        return env
    if env.gymnasium_state is not None:
        return envs.from_gymnasium(env.spec.id)
    return envs.from_gymnasium(lambda: envs.to_gymnasium(env))
