"""A function of small arrays, for one row, as operations on vectors over all rows: one for each of
its numbers.

JAX can map such a function over rows itself (`jax.vmap`), but then reading a number of an array is
a slice of an array over rows, and stacking numbers copies them, which XLA does not fuse and whose
transposes are pads. Here the function is traced once, and what only moves numbers about
disappears."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Shaped

# primitives that hold a function, and that compute each number from those at its place
CALLS, ELEMENTWISE = (
    frozenset(names.split())
    for names in (
        "jit pjit",
        """abs acos acosh add and asin asinh atan atan2 atanh cbrt ceil clamp convert_element_type
        copy cos cosh div eq erf exp exp2 expm1 floor ge gt integer_pow is_finite le log log1p
        logistic lt max min mul ne neg not or pow rem round rsqrt select_n sign sin sinh
        sqrt square stop_gradient sub tan tanh xor""",
    )
)

# vectors or scalars of JAX in an array of objects, of the shape of one row's array
Numbers = Shaped[np.ndarray, "..."]


def numbers_of(x: Array, rank: int) -> Numbers:
    """The numbers of an array over rows, of which so many axes are those of one row."""
    shape = x.shape[:rank]
    return filled([x[place] for place in np.ndindex(shape)], shape)


def _broadcast(
    x: Numbers, shape: tuple[int, ...], broadcast_dimensions: tuple[int, ...], **_: Any
) -> Numbers:
    axes = [k for k in range(len(shape)) if k not in broadcast_dimensions]
    return np.broadcast_to(np.expand_dims(x, axes), shape)


def _sliced(x: Numbers, start_indices: Any, limit_indices: Any, strides: Any) -> Numbers:
    return x[tuple(map(slice, start_indices, limit_indices, strides or [1] * x.ndim))]


MOVES: dict[str, Callable[..., Any]] = {  # primitives that only move numbers, in NumPy
    "broadcast_in_dim": _broadcast,
    "concatenate": lambda *parts, dimension: np.concatenate(parts, dimension),
    "reshape": lambda x, new_sizes, **_: x.reshape(new_sizes),
    "rev": lambda x, dimensions: np.flip(x, dimensions),
    "slice": _sliced,
    "split": lambda x, sizes, axis: np.split(x, np.cumsum(sizes)[:-1], axis),
    "squeeze": lambda x, dimensions: np.squeeze(x, dimensions),
    "stack": lambda *parts, axis, **_: np.stack(parts, axis),
    "transpose": lambda x, permutation: x.transpose(permutation),
    "unstack": lambda x, axis, **_: [
        np.squeeze(one, axis) for one in np.split(x, x.shape[axis], axis)
    ],
}


class Traced:
    """A function that is traced, for one row."""

    def __init__(self, function: Callable[..., Array], *operands: Numbers) -> None:
        """Traces it for operands of these shapes."""
        row = [
            jax.ShapeDtypeStruct(x.shape, x.flat[0].dtype if x.size else float) for x in operands
        ]
        self._closed = jax.make_jaxpr(function)(*row)
        self.size = _size(self._closed)

    def __call__(self, *operands: Numbers) -> Numbers:
        """Its numbers for all rows, of one shape. Raises NotImplementedError: no rule for an
        operation."""
        (found,) = _evaluated(self._closed, operands)
        return found


def _size(closed: Any) -> int:
    """Number of operations on vectors."""

    def own(x):
        return (
            _size(x.params["jaxpr"])
            if x.primitive.name in CALLS
            else math.prod(x.outvars[0].aval.shape)
        )

    return sum(own(x) for x in closed.jaxpr.eqns if x.primitive.name not in MOVES)


def _evaluated(closed: Any, operands: Any) -> list[Numbers]:
    jaxpr = closed.jaxpr
    known = dict(zip(jaxpr.constvars, map(_constant, closed.consts), strict=True))
    known |= zip(jaxpr.invars, operands, strict=True)

    def read(x):
        return _constant(x.val) if hasattr(x, "val") else known[x]  # a literal or a variable

    for equation in jaxpr.eqns:
        given = [read(x) for x in equation.invars]
        known |= zip(equation.outvars, _applied(equation, given), strict=True)
    return [read(x) for x in jaxpr.outvars]


def _constant(x: Any) -> Numbers:
    x = jnp.asarray(x)
    return numbers_of(x, x.ndim)


def filled(values: Sequence[Any], shape: tuple[int, ...] = (-1,)) -> Numbers:
    """Numbers of a shape."""
    found = np.empty(len(values), object)
    for k, value in enumerate(values):  # at once NumPy would look into them
        found[k] = value
    return found.reshape(shape)


def _applied(equation: Any, given: list[Numbers]) -> list[Numbers]:
    """The results of a primitive."""
    name = equation.primitive.name
    parameters = equation.params
    shape = equation.outvars[0].aval.shape

    def total(rows):
        return filled([sum(row[1:], start=row[0]) for row in rows], shape)

    if name in CALLS:
        return _evaluated(parameters["jaxpr"], given)
    if name in MOVES:
        moved = MOVES[name](*given, **parameters)
        return moved if equation.primitive.multiple_results else [moved]
    if name in ELEMENTWISE:
        same = [np.broadcast_to(x, shape).ravel() for x in given]
        return [filled([_bound(equation, numbers) for numbers in zip(*same, strict=True)], shape)]
    if name == "reduce_sum":
        axes = parameters["axes"]
        kept = [k for k in range(given[0].ndim) if k not in axes]
        return [total(given[0].transpose(*kept, *axes).reshape(math.prod(shape), -1))]
    if name == "dot_general" and not any(parameters["dimension_numbers"][1]):
        axes = parameters["dimension_numbers"][0]
        a, b = (np.moveaxis(x, k, range(len(k))) for x, k in zip(given, axes, strict=True))
        a, b = (x.reshape(math.prod(x.shape[: len(axes[0])]), -1).T for x in (a, b))
        return [total([[x * y for x, y in zip(p, q, strict=True)] for p in a for q in b])]
    raise NotImplementedError(name)


def _bound(equation: Any, numbers: tuple[Any, ...]) -> Array:
    shape = np.broadcast_shapes(*map(np.shape, numbers))
    return equation.primitive.bind(
        *(jnp.broadcast_to(x, shape) for x in numbers), **equation.params
    )
