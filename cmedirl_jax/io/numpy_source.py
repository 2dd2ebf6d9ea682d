"""A JAX function as one file of Python that needs numpy alone.

The function is traced for a batch of any size, and each operation of the trace becomes a line. A
new operation is an entry in `_OPERATIONS`.
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
    (shape,) = (variable.aval.shape[1:] for variable in closed.jaxpr.outvars)
    lines.add(f"return np.asarray({result}, np.float32).reshape({_shape(['*_leading', *shape])})")
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
            if isinstance(inner, core.ClosedJaxpr):
                constants = [self.constant(value) for value in inner.consts]
                return self.inline(inner.jaxpr, [*constants, *arguments])
            return self.inline(inner, arguments)
        if kind not in _OPERATIONS:
            raise ValueError(f"numpy's file has no {kind}, which the function uses")
        (result,) = equation.outvars
        text, dtype = _OPERATIONS[kind](equation, *arguments), result.aval.dtype
        if dtype.kind in "iu":
            # Numpy counts and sums integers in 64 bits.
            text = f"np.asarray({text}).astype({_dtype(dtype)})"
        self._count += 1
        self.add(f"_v{self._count} = {text}")
        return [f"_v{self._count}"]


def _literal(of: Any) -> str:
    value = np.asarray(of.val, of.aval.dtype)
    # As text: infinity and NaN have no literal.
    number = value.item() if value.dtype == bool else f'"{value.item()!r}"'
    return f"{_dtype(value.dtype)}({number})"


def _dtype(dtype: Any) -> str:
    if dtype.kind not in "biuf":
        raise ValueError(f"numpy's file has no {dtype.name}")
    return f"np.{'bool_' if dtype.kind == 'b' else dtype.name}"


Write = Callable[..., str]
"""`(equation, *argument expressions) -> expression`."""


def _call(function: str) -> Write:
    return lambda equation, *arguments: f"{function}({', '.join(arguments)})"


def _infix(sign: str) -> Write:
    return lambda equation, left, right: f"{left} {sign} {right}"


def _reduce(function: str) -> Write:
    return lambda equation, x: f"{function}({x}, axis={tuple(equation.params['axes'])})"


def _shape(shape: Sequence[Any]) -> str:
    """A shape, in which `batch` may occur."""
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"


def _broadcast(equation: Any, x: str) -> str:
    shape, kept = equation.params["shape"], equation.params["broadcast_dimensions"]
    sizes = [1] * len(shape)
    for axis, size in zip(kept, equation.invars[0].aval.shape, strict=True):
        sizes[axis] = size
    return f"np.broadcast_to(np.reshape({x}, {_shape(sizes)}), {_shape(shape)})"


def _reshape(equation: Any, x: str) -> str:
    return f"np.reshape({x}, {_shape(equation.outvars[0].aval.shape)})"


def _convert(equation: Any, x: str) -> str:
    return f"np.asarray({x}).astype({_dtype(equation.params['new_dtype'])})"


def _divide(equation: Any, left: str, right: str) -> str:
    if equation.outvars[0].aval.dtype.kind in "iu":
        raise ValueError("numpy's file has no division of integers")
    return f"{left} / {right}"


def _select(equation: Any, which: str, *cases: str) -> str:
    if len(cases) != 2:
        raise ValueError("numpy's file has no choice among more than two")
    return f"np.where({which}, {cases[1]}, {cases[0]})"


def _slice(equation: Any, x: str) -> str:
    params = equation.params
    strides = params["strides"] or [1] * len(params["start_indices"])
    parts = zip(params["start_indices"], params["limit_indices"], strides, strict=True)
    return f"{x}[{', '.join(f'{start}:{stop}:{step}' for start, stop, step in parts)}]"


def _dot(equation: Any, left: str, right: str) -> str:
    (contracted, batched), ranks = (
        equation.params["dimension_numbers"],
        [len(of.aval.shape) for of in equation.invars],
    )
    if ranks == [2, 2] and (contracted, batched) == (((1,), (0,)), ((), ())):
        return f"{left} @ {right}"
    letters = iter("abcdefghijklmnopqrstuvwxyz")
    names = [[""] * rank for rank in ranks]
    for pairs in (batched, contracted):
        for axes in zip(*pairs, strict=True):
            letter = next(letters)
            for name, axis in zip(names, axes, strict=True):
                name[axis] = letter
    free = [[axis for axis, letter in enumerate(name) if not letter] for name in names]
    for name, axes in zip(names, free, strict=True):
        for axis in axes:
            name[axis] = next(letters)
    kept = [names[0][axis] for axis in batched[0]]
    kept += [name[axis] for name, axes in zip(names, free, strict=True) for axis in axes]
    subscripts = f"{''.join(names[0])},{''.join(names[1])}->{''.join(kept)}"
    return f'np.einsum("{subscripts}", {left}, {right})'


def _gather(equation: Any, x: str, index: str) -> str:
    """One window, or many rows: then every indexed axis is dropped, the others are taken whole."""
    numbers, sizes = equation.params["dimension_numbers"], equation.params["slice_sizes"]
    shape, indexed = equation.invars[0].aval.shape, numbers.start_index_map
    if equation.params["mode"] == jax.lax.GatherScatterMode.FILL_OR_DROP:
        raise ValueError("numpy's file has no gather that fills what is out of range")
    # An index out of range is moved into it.
    places = [
        f"np.clip({index}[..., {place}], 0, {shape[axis]} - {sizes[axis]})"
        for place, axis in enumerate(indexed)
    ]
    if len(equation.invars[1].aval.shape) == 1:
        windows = [":"] * len(shape)
        for place, axis in zip(places, indexed, strict=True):
            windows[axis] = f"{place} : {place} + {sizes[axis]}"
        return _reshape(equation, f"{x}[{', '.join(windows)}]")
    whole = [axis for axis in range(len(shape)) if axis not in indexed]
    if (
        numbers.operand_batching_dims
        or tuple(numbers.collapsed_slice_dims) != tuple(sorted(indexed))
        or any(sizes[axis] != shape[axis] for axis in whole)
    ):
        raise ValueError("numpy's file has no such gather")
    count = len(equation.outvars[0].aval.shape) - len(numbers.offset_dims)
    rows = f"np.transpose({x}, {(*indexed, *whole)})[{', '.join(places)}]"
    if not numbers.offset_dims:
        return rows
    moved = tuple(range(count, count + len(numbers.offset_dims)))
    return f"np.moveaxis({rows}, {moved}, {tuple(numbers.offset_dims)})"


def _iota(equation: Any) -> str:
    shape, axis = equation.params["shape"], equation.params["dimension"]
    sizes = [size if place == axis else 1 for place, size in enumerate(shape)]
    dtype = _dtype(equation.params["dtype"])
    counted = f"np.arange({shape[axis]}, dtype={dtype}).reshape({_shape(sizes)})"
    return f"np.broadcast_to({counted}, {_shape(shape)})"


_OPERATIONS: dict[str, Write] = {
    "add": _infix("+"),
    "add_any": _infix("+"),
    "sub": _infix("-"),
    "mul": _infix("*"),
    "div": _divide,
    "pow": _infix("**"),
    "rem": _call("np.fmod"),
    "eq": _infix("=="),
    "ne": _infix("!="),
    "lt": _infix("<"),
    "le": _infix("<="),
    "gt": _infix(">"),
    "ge": _infix(">="),
    "and": _infix("&"),
    "or": _infix("|"),
    "max": _call("np.maximum"),
    "min": _call("np.minimum"),
    "abs": _call("np.abs"),
    "neg": _call("np.negative"),
    "not": _call("np.invert"),
    "sign": _call("np.sign"),
    "floor": _call("np.floor"),
    "exp": _call("np.exp"),
    "expm1": _call("np.expm1"),
    "log": _call("np.log"),
    "log1p": _call("np.log1p"),
    "tanh": _call("np.tanh"),
    "sin": _call("np.sin"),
    "cos": _call("np.cos"),
    "sqrt": _call("np.sqrt"),
    "square": _call("np.square"),
    "copy": _call("np.copy"),
    "stop_gradient": _call("np.asarray"),
    "is_finite": _call("np.isfinite"),
    "rsqrt": lambda equation, x: f"np.float32(1.0) / np.sqrt({x})",
    "logistic": lambda equation, x: f"np.float32(0.5) * (np.tanh(np.float32(0.5) * {x}) + 1)",
    "integer_pow": lambda equation, x: f"{x} ** {equation.params['y']}",
    "clamp": lambda equation, low, x, high: f"np.clip({x}, {low}, {high})",
    "reduce_sum": _reduce("np.sum"),
    "reduce_prod": _reduce("np.prod"),
    "reduce_max": _reduce("np.max"),
    "reduce_min": _reduce("np.min"),
    "reduce_and": _reduce("np.all"),
    "reduce_or": _reduce("np.any"),
    "argmax": lambda equation, x: f"np.argmax({x}, axis={equation.params['axes'][0]})",
    "select_n": _select,
    "convert_element_type": _convert,
    "broadcast_in_dim": _broadcast,
    "reshape": _reshape,
    "squeeze": _reshape,
    "expand_dims": _reshape,
    "transpose": lambda equation, x: f"np.transpose({x}, {tuple(equation.params['permutation'])})",
    "concatenate": lambda equation, *parts: (
        f"np.concatenate(({', '.join(parts)},), axis={equation.params['dimension']})"
    ),
    "slice": _slice,
    "dot_general": _dot,
    "gather": _gather,
    "iota": _iota,
}
"""Each operation of JAX that rewards and policies use, as an expression of numpy."""
