"""A JAX function as one file of Python that needs numpy alone.

The function is traced for a batch of any size, and each operation of the trace becomes a line. A
new operation is an entry in `numpy_operations.OPERATIONS`.
"""

import base64
import io
import keyword
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jax import export
from jax.extend import core

from cmedirl_jax.io.numpy_operations import OPERATIONS, dtype_name, shape_text

_TEMPLATE = '''"""{doc}"""

import base64
import io

import numpy as np


def {name}({inputs}):
    """Return `{output}` float32 of {shapes}."""
{body}


def _rows(value, size, leading):
    value = np.asarray(value, np.float32)
    if value.shape[-1:] != (size,) or leading not in (None, value.shape[:-1]):
        wanted = f"leading axes {{leading}} and then {{size}}"
        raise ValueError(f"expected {{wanted}}, got {{value.shape}}")
    return value.reshape(-1, size)


_ARRAYS = dict(np.load(io.BytesIO(base64.b64decode("""
{arrays}
""")), allow_pickle=False))
'''
_BATCH = "_batch"
"""The number of rows, in the file."""
_TAKEN = ("base64", "io", "np")
_INLINED = (
    *("jit", "pjit", "closed_call", "custom_jvp_call", "custom_vjp_call"),
    *("checkpoint", "remat", "remat2"),
)
"""Operations that hold a function of their own."""


def write(
    name: str, function: Callable[..., jax.Array], inputs: Mapping[str, int], doc: str
) -> str:
    """Write the source of a module with one function, which holds its parameters.

    Args:
        name: of the function.
        function: takes an array `[B, D]` float32 for each input, returns `[B]` or `[B, ...]`.
        inputs: the name and the size D of each input.
        doc: the module's docstring.

    Returns:
        The source. Its function takes `[..., D]` for each input, with equal leading axes.

    Raises:
        ValueError: if the function has an operation that is not written here.
    """
    for each in (name, *inputs):
        if not each.isidentifier() or keyword.iskeyword(each) or each.startswith("_"):
            raise ValueError(f"{each!r} is no public name of Python")
        if each in _TAKEN:
            raise ValueError(f"{each!r} is a name of the file's own")
    (batch,) = export.symbolic_shape(_BATCH)
    arguments = [jax.ShapeDtypeStruct((batch, size), np.float32) for size in inputs.values()]
    closed = jax.make_jaxpr(function)(*arguments)
    lines = _Lines()
    names = [lines.constant(value) for value in closed.consts]
    # Arguments become float32 rows.
    first = next(iter(inputs))
    lines.add(f"_leading = np.shape({first})[:-1]")
    for each, size in inputs.items():
        lines.add(f"{each} = _rows({each}, {size}, {'None' if each == first else '_leading'})")
    lines.add(f"{_BATCH} = len({first})")
    (result,) = lines.inline(closed.jaxpr, [*names, *inputs])
    variable: Any = closed.jaxpr.outvars[0]
    shape = variable.aval.shape[1:]
    lines.add(
        f"return np.asarray({result}, np.float32).reshape({shape_text(['*_leading', *shape])})"
    )
    return _TEMPLATE.format(
        doc=doc,
        name=name,
        inputs=", ".join(inputs),
        output=_brackets(*shape),
        shapes=" and ".join(f"{each} `{_brackets(size)}`" for each, size in inputs.items()),
        body="\n".join(f"    {line}" for line in lines.written),
        arrays=lines.encoded(),
    )


def _brackets(*shape: int) -> str:
    return f"[{', '.join(['...', *map(str, shape)])}]"


class _Lines:
    """The lines that have been written, and the arrays that they name."""

    def __init__(self):
        self.written: list[str] = []
        self._arrays: dict[str, np.ndarray] = {}
        self._count = 0

    def add(self, line: str) -> None:
        self.written.append(line)

    def constant(self, value: Any) -> str:
        """The expression of an array that the function closes over."""
        name = f"c{len(self._arrays)}"
        self._arrays[name] = np.asarray(value)
        return f'_ARRAYS["{name}"]'

    def encoded(self) -> str:
        """All arrays as an npz file in base64, in lines."""
        content = io.BytesIO()
        np.savez_compressed(content, **self._arrays)  # type: ignore[arg-type]
        text = base64.b64encode(content.getvalue()).decode()
        return "\n".join(text[start : start + 100] for start in range(0, len(text), 100))

    def inline(self, jaxpr: Any, inputs: Sequence[str]) -> list[str]:
        """Write the operations of a trace; returns the expressions of its results."""
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], inputs, strict=True))

        def expression(of: Any) -> str:
            return _literal(of) if isinstance(of, core.Literal) else known[of]

        for equation in jaxpr.eqns:
            texts = self._operation(equation, [expression(of) for of in equation.invars])
            known.update(zip(equation.outvars, texts, strict=True))
        return [expression(of) for of in jaxpr.outvars]

    def _operation(self, equation: Any, arguments: list[str]) -> list[str]:
        kind = equation.primitive.name
        if kind in _INLINED:
            inner = equation.params.get("jaxpr") or equation.params["call_jaxpr"]
            constants = [self.constant(value) for value in getattr(inner, "consts", ())]
            return self.inline(getattr(inner, "jaxpr", inner), [*constants, *arguments])
        if kind not in OPERATIONS:
            raise ValueError(f"numpy's file has no {kind}, which the function uses")
        text, results = OPERATIONS[kind](equation, *arguments), equation.outvars
        if len(results) == 1 and (dtype := results[0].aval.dtype).kind in "iu":
            # Numpy counts and sums integers in 64 bits; parts of an array keep their type.
            text = f"np.asarray({text}).astype({dtype_name(dtype)})"
        names = [f"_v{self._count + index}" for index in range(1, len(results) + 1)]
        self._count += len(results)
        self.add(f"{', '.join(names)} = {text}")
        return names


def _literal(of: Any) -> str:
    value = np.asarray(of.val, of.aval.dtype)
    # As text: infinity and NaN have no literal.
    number = value.item() if value.dtype == bool else f'"{value.item()!r}"'
    return f"{dtype_name(value.dtype)}({number})"
