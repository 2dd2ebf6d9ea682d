"""The operations of a JAX function's trace, each as an expression of numpy."""

import itertools
from collections.abc import Callable, Sequence
from typing import Any

import jax


def dtype_name(dtype: Any) -> str:
    """A dtype in numpy's words.

    Raises:
        ValueError: for one that numpy has not.
    """
    if dtype.kind not in "biuf":
        raise ValueError(f"numpy's file has no {dtype.name}")
    return f"np.{'bool_' if dtype.kind == 'b' else dtype.name}"


Write = Callable[..., str]
"""`(equation, *argument expressions) -> expression`, of as many values as there are results."""


def _call(function: str) -> Write:
    return lambda equation, *arguments: f"{function}({', '.join(arguments)})"


def _infix(sign: str) -> Write:
    return lambda equation, left, right: f"{left} {sign} {right}"


def _reduce(function: str) -> Write:
    return lambda equation, x: f"{function}({x}, axis={tuple(equation.params['axes'])})"


def shape_text(shape: Sequence[Any]) -> str:
    """A shape as a tuple, whose sizes may be names."""
    return f"({', '.join(map(str, shape))}{',' * (len(shape) == 1)})"


def _broadcast(equation: Any, x: str) -> str:
    shape, kept = equation.params["shape"], equation.params["broadcast_dimensions"]
    sizes = [1] * len(shape)
    for axis, size in zip(kept, equation.invars[0].aval.shape, strict=True):
        sizes[axis] = size
    return f"np.broadcast_to(np.reshape({x}, {shape_text(sizes)}), {shape_text(shape)})"


def _reshape(equation: Any, x: str) -> str:
    return f"np.reshape({x}, {shape_text(equation.outvars[0].aval.shape)})"


def _unstack(equation: Any, x: str) -> str:
    return _results(equation, f"np.moveaxis({x}, {equation.params['axis']}, 0)")


def _split(equation: Any, x: str) -> str:
    ends = list(itertools.accumulate(equation.params["sizes"]))[:-1]
    return _results(equation, f"np.split({x}, {ends}, axis={equation.params['axis']})")


def _results(equation: Any, parts: str) -> str:
    return parts if len(equation.outvars) > 1 else f"{parts}[0]"


def _convert(equation: Any, x: str) -> str:
    return f"np.asarray({x}).astype({dtype_name(equation.params['new_dtype'])})"


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
    dtype = dtype_name(equation.params["dtype"])
    counted = f"np.arange({shape[axis]}, dtype={dtype}).reshape({shape_text(sizes)})"
    return f"np.broadcast_to({counted}, {shape_text(shape)})"


OPERATIONS: dict[str, Write] = {
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
    "unstack": _unstack,
    "split": _split,
    "stack": lambda equation, *parts: (
        f"np.stack(({', '.join(parts)},), axis={equation.params['axis']})"
    ),
    "concatenate": lambda equation, *parts: (
        f"np.concatenate(({', '.join(parts)},), axis={equation.params['dimension']})"
    ),
    "slice": _slice,
    "dot_general": _dot,
    "gather": _gather,
    "iota": _iota,
}
"""Each operation of JAX that rewards and policies use, as an expression of numpy."""
