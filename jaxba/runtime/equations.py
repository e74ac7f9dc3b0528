"""The graph of a program's equations, some of whose values differ between the parts of its data
(parts.py)."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

from jax.extend.core import JaxprEqn

KEPT = "kept"  # name of values that are stored


@dataclass(eq=False)
class Node:
    """An equation of a program, or an array that is there."""

    equation: JaxprEqn | None
    inputs: list[Value]
    level: int = 0
    stored: dict[int, Any] | None = None  # results by number; divided ones with a leading axis
    collective: bool = False  # whether it sums over parts
    divided: Sequence[bool] = ()  # whether each of its results is

    @property
    def name(self) -> str:
        """Name of its operation."""
        return "" if self.equation is None else self.equation.primitive.name

    @property
    def params(self) -> dict[str, Any]:
        """Parameters of its operation."""
        return {} if self.equation is None else self.equation.params

    @property
    def is_kept(self) -> bool:
        """Whether its result is stored."""
        return self.name == "name" and self.params["name"] == KEPT


class Value(NamedTuple):
    """A result of a node."""

    node: Node
    index: int
    divided: bool

    @property
    def there(self) -> bool:
        """Whether it is stored."""
        return self.node.stored is not None and self.index in self.node.stored

    def get(self) -> Any:
        """What is stored."""
        assert self.node.stored is not None
        return self.node.stored[self.index]


def given_value(x: Any, divided: bool) -> Value:
    return Value(Node(None, [], stored={0: x}), 0, divided)


def nodes_of(values: Iterable[Value]) -> list[Node]:
    """All nodes that values are made of and that are not computed yet."""
    found: dict[Node, None] = {}
    stack = [one.node for one in values]
    while stack:
        node = stack.pop()
        if node not in found and node.stored is None:
            found[node] = None
            stack += [one.node for one in node.inputs]
    return list(found)


def prepared(values: Iterable[Value]) -> list[Value]:
    """The stored divided values of which values are made. Computes the common ones, which must not
    be done inside of a loop, where they would be of that loop."""
    seen: dict[Value, None] = {}
    stack = list(values)
    while stack:
        one = stack.pop()
        if one in seen:
            continue
        seen[one] = None
        if not one.divided:
            common(one)
        elif not one.there:
            stack += one.node.inputs
    return [one for one in seen if one.divided and one.there]


def common(value: Value) -> Any:
    """A common value, computed if it is not there."""
    stack = [value.node]
    while stack:
        node = stack[-1]
        missing = (
            [one.node for one in node.inputs if one.node.stored is None]
            if node.stored is None
            else []
        )
        if missing:
            stack += missing
            continue
        stack.pop()
        if node.stored is None:
            node.stored = dict(enumerate(evaluated(node, [one.get() for one in node.inputs])))
    return value.get()


def inside(value: Value, local: dict[Value, Any]) -> Any:
    """A value in one part; `local` are the divided values that are known there."""
    stack = [value] if value.divided else []
    while stack:
        one = stack[-1]
        missing = [other for other in one.node.inputs if other.divided and other not in local]
        if one not in local and missing:
            stack += missing
            continue
        stack.pop()
        if one not in local:
            found = evaluated(
                one.node, [local[x] if x.divided else x.get() for x in one.node.inputs]
            )
            local.update({Value(one.node, k, True): x for k, x in enumerate(found)})
    return local[value] if value.divided else value.get()


def evaluated(node: Node, inputs: list[Any]) -> list[Any]:
    """The results of an equation."""
    assert node.equation is not None
    params = node.equation.primitive.get_bind_params(node.equation.params)
    with node.equation.ctx.manager:
        found = node.equation.primitive.bind(*inputs, **params)
    return list(found) if node.equation.primitive.multiple_results else [found]
