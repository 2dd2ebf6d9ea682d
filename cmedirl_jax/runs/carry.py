"""A learner's reward and policy as files that other programs read; `io.export` writes them."""

import importlib.util
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import polars as pl

from cmedirl_jax.io import atomic, export
from cmedirl_jax.io.export import Function
from cmedirl_jax.runs.errors import UserError
from cmedirl_jax.runs.load import Functions, LearnedCell
from cmedirl_jax.runs.storage import folder as run_folder

README = """# The reward that {method} learned for {task}

| file | what it is |
| --- | --- |
| `reward.py`, `policy.py` | functions of numpy, each in one file that needs nothing else |
| `reward.jax`, `policy.jax` | the same as what `jax.export` serialises, for CPU and GPU |
| `params.safetensors` | the parameters of both |
| `card.json` | the task, how the reward was learned, what it knows, its licence |

```py
from reward import reward  # observation [..., {observation}], action [..., {action}] -> [...]
```

```py
from pathlib import Path

from jax import export

reward = export.deserialize(bytearray(Path("reward.jax").read_bytes())).call
value = reward(observations, actions)  # [B, {observation}], [B, {action}] float32 -> [B]
```

`cmedirl_jax.io.export.load` reads the folder back.
"""


def check(folder: Path, learned: LearnedCell) -> None:
    """Refuse an export before the work that comes before it.

    Raises:
        UserError: without the extra, if something lies in the folder's place, if the folder cannot
            be written, or for a method that learns no reward.
    """
    missing = [
        name for name in ("safetensors", "flatbuffers") if not importlib.util.find_spec(name)
    ]
    if missing:
        raise UserError(
            f"--export: {' and '.join(missing)} not installed; "
            "run: python -m pip install 'cmedirl-jax[export]'"
        )
    if folder.exists():
        raise UserError(f"--export: {folder} exists; take another folder, or remove it")
    try:
        atomic.check_writable(folder.parent)
    except OSError as error:
        raise UserError(f"--export: cannot write to {folder} ({error.strerror})") from error
    if not learned.has_rewards:
        raise UserError(f"--method: {learned.method.name} learns no reward")


def save(
    folder: Path,
    run: Path,
    learned: LearnedCell,
    seed: int,
    *,
    licence: str,
    card: pl.DataFrame,
    summary: pl.DataFrame,
) -> None:
    """Write a learner's reward and policy to a new folder.

    Args:
        folder: where nothing lies yet.
        run: the folder of the learner's run.
        learned: its cell.
        seed: which learner.
        licence: of the reward.
        card: a row for each reward of the run.
        summary: a row for each measure of each cell.

    Raises:
        UserError: if the learner diverged, the run's configuration cannot be read, or a function
            cannot be written in numpy.
        ValueError: if the method learns no reward, or a file of its cell is damaged.
        FileExistsError: if something lies at `folder`.
        OSError: if the folder cannot be written.
        ModuleNotFoundError: without the extra `export`.
    """
    from cmedirl_jax.runs.report.reward_cards import MEASURES

    key, spec = learned.cell.key, learned.task
    mine = (pl.col("method") == key.method) & (pl.col("n_demos") == key.n_demos)
    own = card.filter(mine, pl.col("seed") == seed)
    if own.is_empty():
        raise UserError(f"--seed: learner {seed} of {key.method} has diverged")
    values = own.row(0, named=True)
    over_seeds = summary.filter(mine).drop("method", "n_demos").to_dicts()
    description = {
        "task": spec.id,
        "observation": {
            "low": _finite(spec.observation_low),
            "high": _finite(spec.observation_high),
        },
        "action": {"low": _finite(spec.action_low), "high": _finite(spec.action_high)},
        "normalisation": learned.settings.architecture.normalise_observation,
        "method": key.method,
        "method_description": learned.method.description,
        "learner": {"seed": seed, "study": key.study, "experts": key.expert},
        "demonstrations": key.n_demos,
        "licence": licence,
        "report_card": {name: values[name] for name in MEASURES if values.get(name) is not None},
        "report_card_over_seeds": over_seeds,
        "measures": MEASURES,
        "versions": run_folder.read(run)["versions"],
    }
    inputs = {"observation": spec.observation_dim, "action": spec.action_dim}
    of_policy = {"observation": spec.observation_dim}
    index = seed - key.first_seed
    functions = {
        "reward": _one(learned.rewards(), index, inputs),
        "policy": _one(learned.policies(), index, of_policy),
    }
    readme = README.format(method=key.method, task=spec.id, **inputs)
    try:
        export.save(folder, functions, description, readme)
    except ValueError as error:
        raise UserError(f"--export: {error}") from error


def _one(functions: Functions, index: int, inputs: Mapping[str, int]) -> Function:
    params = jax.tree.map(lambda leaf: np.asarray(leaf[index]), functions.params)
    return Function(functions.function, params, inputs)


def _finite(bounds: np.ndarray) -> list[Any]:
    """Bounds as JSON has them: null where there is none."""
    return [float(bound) if np.isfinite(bound) else None for bound in bounds]
