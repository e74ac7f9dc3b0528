"""Array aliases and limits that every room may use, and how its dataclasses become pytrees."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax import Array

AnyArray = np.ndarray | Array
"""An array on the host or on a device; tracers are of the second kind."""

LARGEST_COUNT = 2**31 - 1
"""Largest count that an option may have: programs count in 32 bits."""

T = TypeVar("T")

SHOWN = 8
"""Most items of a tuple that `outline` shows."""


class InputError(ValueError):
    """What a user gave cannot be used. The message is one line for the user, and commands print it
    alone."""


class ArrayRecord:
    """Base of dataclasses of arrays, which are made with `eq=False, repr=False`. Two are equal if
    they are of one class and all their arrays and other values are equal, with NaN equal to NaN.
    Shown with types and shapes, in one line."""

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return all(
            same(getattr(self, x.name), getattr(other, x.name)) for x in fields(cast(Any, self))
        )

    __hash__ = None  # pyright: ignore[reportAssignmentType]  # arrays can be written to

    def __repr__(self) -> str:
        values = {field.name: getattr(self, field.name) for field in fields(cast(Any, self))}
        shown = ", ".join(
            f"{name}={outline(value)}" for name, value in values.items() if value is not None
        )
        return f"{type(self).__name__}({shown})"


def same(one: Any, other: Any) -> bool:
    """Whether two values are equal: arrays if their shapes and all entries are, and tuples if all
    items are."""
    if isinstance(one, AnyArray) or isinstance(other, AnyArray):
        one = np.asarray(one)
        other = np.asarray(other)
        return one.shape == other.shape and bool(
            np.all((one == other) | ((one != one) & (other != other)))
        )
    if isinstance(one, tuple) and isinstance(other, tuple):
        return type(one) is type(other) and len(one) == len(other) and all(map(same, one, other))
    return bool(one == other)


def differ(one: Any, other: Any) -> bool:
    """Whether two values are not the `same`: for a named tuple, since tuples bring a comparison of
    their own."""
    return not same(one, other)


def outline(value: Any) -> str:
    """A value in one short line: arrays by type and shape."""
    if isinstance(value, AnyArray) and value.ndim:
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if isinstance(value, tuple):
        names = getattr(value, "_fields", ("",) * len(value))
        items = [
            f"{name}={outline(x)}" if name else outline(x)
            for name, x in zip(names, value, strict=True)
        ]
        kind = type(value).__name__ if any(names) else ""
        return f"{kind}({', '.join(items[:SHOWN])}{', ...' if len(items) > SHOWN else ''})"
    return repr(value)


def register_pytree(kind: type[T]) -> type[T]:
    """Registers a dataclass as a pytree: a decorator for policies and environments of your own.

    `jax.tree_util.register_dataclass` does the same, with two differences:

    - There two classes with as many fields are one structure (seen in JAX 0.10.2 and 0.12.0), so
      that one in some hundred processes runs the compiled program of the other class. Here they are
      two structures.
    - A tree is rebuilt without `__init__`. JAX rebuilds pytrees with tracers, batches, shapes or
      None in the place of arrays. Annotations speak of what people pass to the constructor, so
      types are checked there, where somebody checks them, and not when JAX rebuilds.

    Fields of `kind`, a dataclass, with the metadata `{"static": True}` are part of the tree's
    structure. Those with `{"host": True}` are not part of the tree, and None when it is rebuilt.
    Returns the class itself."""
    host = [field.name for field in fields(kind) if field.metadata.get("host")]  # pyright: ignore
    data = [field.name for field in fields(kind) if not field.metadata]  # pyright: ignore
    static = [field.name for field in fields(kind) if field.metadata.get("static")]  # pyright: ignore

    def flatten(node):
        return [getattr(node, name) for name in data], tuple(getattr(node, name) for name in static)

    def flatten_with_keys(node):
        children, structure = flatten(node)
        return [
            (jax.tree_util.GetAttrKey(n), child) for n, child in zip(data, children, strict=True)
        ], structure

    def unflatten(structure, children):
        node = object.__new__(kind)
        nothing = ((name, None) for name in host)
        for name, value in [
            *zip(data, children, strict=True),
            *zip(static, structure, strict=True),
            *nothing,
        ]:
            object.__setattr__(node, name, value)
        return node

    jax.tree_util.register_pytree_with_keys(kind, flatten_with_keys, unflatten, flatten)
    return kind
