"""Array aliases and limits that every room may use, and how its dataclasses become pytrees."""

from __future__ import annotations

from dataclasses import fields
from typing import TypeVar

import jax
import numpy as np
from jax import Array

AnyArray = np.ndarray | Array
"""An array on the host or on a device; tracers are of the second kind."""

LARGEST_COUNT = 2**31 - 1
"""Largest count that an option may have: programs count in 32 bits."""

T = TypeVar("T")


def register_pytree(kind: type[T]) -> type[T]:
    """Registers a dataclass as a pytree: a decorator for policies and environments of your own.

    `jax.tree_util.register_dataclass` does the same, with two differences:

    - There two classes with as many fields are one structure (seen in JAX 0.10.2 and 0.12.0), so that one in some
      hundred processes runs the compiled program of the other class. Here they are two structures.
    - A tree is rebuilt without `__init__`. JAX rebuilds pytrees with tracers, batches, shapes or None in the place of
      arrays. Annotations speak of what people pass to the constructor, so types are checked there, where somebody
      checks them, and not when JAX rebuilds.

    Args:
        kind: a dataclass; fields with the metadata `{"static": True}` are part of the tree's structure. Those with
            `{"host": True}` are not part of the tree, and None when it is rebuilt.

    Returns:
        The class itself.
    """
    host = [field.name for field in fields(kind) if field.metadata.get("host")]  # pyright: ignore
    data = [field.name for field in fields(kind) if not field.metadata]  # pyright: ignore
    static = [field.name for field in fields(kind) if field.metadata.get("static")]  # pyright: ignore

    def flatten(node):
        return [getattr(node, name) for name in data], tuple(getattr(node, name) for name in static)

    def flatten_with_keys(node):
        children, structure = flatten(node)
        return [(jax.tree_util.GetAttrKey(n), child) for n, child in zip(data, children, strict=True)], structure

    def unflatten(structure, children):
        node = object.__new__(kind)
        nothing = ((name, None) for name in host)
        for name, value in [*zip(data, children, strict=True), *zip(static, structure, strict=True), *nothing]:
            object.__setattr__(node, name, value)
        return node

    jax.tree_util.register_pytree_with_keys(kind, flatten_with_keys, unflatten, flatten)
    return kind
