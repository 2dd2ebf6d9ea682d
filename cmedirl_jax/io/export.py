"""Functions with parameters, in files that other programs read without this library.

    reward = Function(reward, params, {"observation": 2, "action": 1})
    export.save("carried", {"reward": reward}, card={"task": "MountainCarContinuous-v0"})
    exported = export.load("carried")
    value = exported.functions["reward"](observation, action)

A folder holds the parameters as safetensors, and each function twice: as what `jax.export`
serialises, and as a file of Python that needs numpy alone. Needs the extra `export`.
"""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import export as jax_export

from cmedirl_jax.io import atomic, numpy_source

PLATFORMS = ("cpu", "cuda")
"""What the exported functions run on."""
PARAMS, CARD, EXPORTED = "params.safetensors", "card.json", ".jax"


class Function(NamedTuple):
    """A function to carry away.

    Attributes:
        function: `(params, *inputs)`, of inputs `[B, D]` float32; returns `[B]` or `[B, ...]`.
        params: a pytree of arrays.
        inputs: the name and the size D of each input.
    """

    function: Callable[..., jax.Array]
    params: Any
    inputs: Mapping[str, int]


class Exported(NamedTuple):
    """What `load` returns.

    Attributes:
        functions: by name; each takes `[..., D]` float32 for each input, with equal leading axes.
        params: arrays by function and place, as "reward/network/params/Dense_0/kernel".
        card: what `save` was given.
    """

    functions: dict[str, Callable[..., jax.Array]]
    params: dict[str, np.ndarray]
    card: dict[str, Any]


def save(
    folder: str | Path,
    functions: Mapping[str, Function],
    card: Mapping[str, Any],
    readme: str = "",
) -> None:
    """Write functions to a new folder, which appears whole.

    Args:
        folder: where nothing lies yet.
        functions: by name, which is an identifier of Python.
        card: what a user should know of them, as JSON writes it.
        readme: text of README.md, in Markdown; empty: no such file.

    Raises:
        FileExistsError: if something lies at `folder`.
        ModuleNotFoundError: without the extra `export`.
        OSError: if the folder cannot be written.
        ValueError: if a function uses an operation that numpy's file lacks, or the card cannot be
            written as JSON.
    """
    # jax.export needs flatbuffers, and says so only where it writes.
    import flatbuffers  # noqa: F401
    from safetensors.numpy import save_file

    folder = Path(folder)
    if folder.exists():
        raise FileExistsError(f"{folder}: exists")
    params = {
        f"{name}/{jax.tree_util.keystr(place, simple=True, separator='/')}".rstrip("/"): leaf
        for name, each in functions.items()
        for place, leaf in jax.tree.leaves_with_path(each.params)
    }
    with atomic.replacing(folder) as partial:
        partial.mkdir(parents=True)
        (partial / CARD).write_text(json.dumps(card, indent=2, allow_nan=False) + "\n")
        if readme:
            (partial / "README.md").write_text(readme)
        # safetensors writes the bytes as they lie in memory.
        arrays = {name: np.asarray(leaf, order="C") for name, leaf in params.items()}
        save_file(arrays, partial / PARAMS)
        for name, each in functions.items():
            bound = _bind(each)
            doc = f"{name.capitalize()} of {card.get('task', 'a task')}, as a function of numpy."
            source = numpy_source.write(name, bound, each.inputs, doc)
            (partial / f"{name}.py").write_text(source)
            (partial / f"{name}{EXPORTED}").write_bytes(_serialised(bound, each.inputs))


def _bind(each: Function) -> Callable[..., jax.Array]:
    params = jax.tree.map(jnp.asarray, each.params)
    return lambda *inputs: each.function(params, *inputs)


def _serialised(function: Callable[..., jax.Array], inputs: Mapping[str, int]) -> bytes:
    (batch,) = jax_export.symbolic_shape("batch")
    arguments = [jax.ShapeDtypeStruct((batch, size), np.float32) for size in inputs.values()]
    exported = jax_export.export(jax.jit(function), platforms=PLATFORMS)(*arguments)
    return bytes(exported.serialize())


def load(folder: str | Path) -> Exported:
    """Read a folder that `save` wrote.

    Raises:
        FileNotFoundError: if nothing was exported there.
        ModuleNotFoundError: without the extra `export`.
        OSError: if a file cannot be read.
        ValueError: if a file is damaged.
    """
    import flatbuffers  # noqa: F401
    from safetensors.numpy import load_file

    folder = Path(folder)
    if not (folder / CARD).is_file():
        raise FileNotFoundError(f"{folder}: holds nothing that was exported")
    try:
        card = json.loads((folder / CARD).read_text())
        params = load_file(folder / PARAMS)
        functions = {
            path.stem: _callable(path.read_bytes()) for path in sorted(folder.glob(f"*{EXPORTED}"))
        }
    except OSError:
        raise
    # Of a damaged file safetensors, flatbuffers and JAX raise errors of many types.
    except Exception as error:
        raise ValueError(
            f"{folder}: a file is damaged ({type(error).__name__}: {error})"
        ) from error
    return Exported(functions, params, card)


def _callable(serialised: bytes) -> Callable[..., jax.Array]:
    exported = jax_export.deserialize(bytearray(serialised))

    def function(*inputs: Any) -> jax.Array:
        arrays = [jnp.asarray(each, jnp.float32) for each in inputs]
        leading, (result,) = arrays[0].shape[:-1], exported.out_avals
        if 0 in leading:
            return jnp.zeros((*leading, *result.shape[1:]), result.dtype)
        rows = exported.call(*(each.reshape(-1, each.shape[-1]) for each in arrays))
        return rows.reshape(*leading, *result.shape[1:])

    return function
