"""Our maximum-entropy IRL on a gridworld: `python -m ... PROBLEM.npz dense|sparse STEPS`."""

import functools
import sys
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import optax

from benchmarks.gridworlds import Problem
from benchmarks.serving import serve_from_command_line
from cmedirl_jax import tabular
from cmedirl_jax.tabular import MaxEntResult, SparseDynamics, Stop
from cmedirl_jax.types import Network

DISCOUNT = 1.0 - 1e-7
"""Where episodes end by themselves: an endless sum has to have one."""


def sparse(transition: np.ndarray) -> SparseDynamics:
    """The same dynamics `[S, A, S]` as lists of successors."""
    most = (transition > 0).sum(axis=-1).max()
    following = np.argsort(-transition, axis=-1, kind="stable")[..., :most]
    return SparseDynamics(
        following.astype(np.int32), np.take_along_axis(transition, following, axis=-1)
    )


def program(path: Path, form: str) -> Any:
    """A function of the number of steps that gives a `MaxEntResult`."""
    problem = Problem(**np.load(path))
    states, actions, _ = problem.transition.shape
    ends = bool(problem.ends)
    discount = DISCOUNT if ends else 1.0
    demonstrations = tabular.empirical_visitation(
        problem.state, problem.action, problem.mask, (states, actions), discount=discount
    )
    table = Network(
        init=lambda key: jnp.full(states, problem.first), apply=lambda table: jnp.asarray(table)
    )
    dynamics = {"dense": problem.transition, "sparse": sparse(problem.transition)}[form]

    @functools.partial(jax.jit, static_argnums=1)
    def fit(dynamics: Any, steps: int) -> MaxEntResult:
        return tabular.deep_maxent_irl(
            jax.random.key(0),
            table,
            (),
            dynamics,
            demonstrations,
            discount=discount,
            horizon=None if ends else problem.state.shape[1],
            absorbing=np.arange(states) == states - 1 if ends else None,
            optimizer=optax.sgd(float(problem.rate)),
            steps=steps,
            stop=Stop(tolerance=1e-9),
        )

    return functools.partial(fit, jax.tree.map(jnp.asarray, dynamics))


def main() -> None:
    """Serve what the command line names."""
    jax.config.update("jax_enable_x64", True)
    path, form, steps = sys.argv[1:]
    fit = program(Path(path), form)

    def facts() -> dict[str, Any]:
        # One step more, whose diagnostics are of the parameters before it.
        result, after = fit(int(steps)), fit(int(steps) + 1)
        return {
            "visitation": result.visitation.sum(axis=1).tolist(),
            "log_likelihood": float(after.info.log_likelihood[-1]),
        }

    serve_from_command_line(lambda steps: jax.block_until_ready(fit(steps)), facts)


if __name__ == "__main__":
    main()
