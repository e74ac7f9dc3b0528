"""A program over the parts of its data, one part after the other: memory for one part at a time.

`in_turns(function, ...)` is `jax.vmap(function, axis_name=...)` without the batch. Values that
differ between the parts are *divided*; all others, sums and maxima over the axis (`lax.psum`,
`lax.pmax`) among them, are *common* and computed once. What is divided is not stored: it is
computed again, part by part, in each pass over the parts in which something is summed. Sums of
which none needs another one are one pass. Stored are only results, the state of loops, and values
that are `kept`. So a loop with a sum in it, as of conjugate gradients, passes over the parts in
each iteration.

The program is traced once, as for one part, and becomes a graph of its equations. A value's *level*
is the number of sums that it depends on, one after the other; passes are made level by level."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax
from jax.ad_checkpoint import checkpoint_name
from jax.extend.core import Jaxpr, JaxprEqn, Literal

from jaxba.runtime import loops
from jaxba.runtime.equations import (
    KEPT,
    Node,
    Value,
    common,
    given_value,
    inside,
    nodes_of,
    prepared,
)
from jaxba.runtime.fusion import compute_unfused

_SUMS: dict[str, Callable[[Any, Any], Any]] = {"psum": jnp.add, "pmax": jnp.maximum}
_CALLS = ("pjit", "jit", "closed_call")


def kept(values: Any) -> Any:
    """The same arrays, stored where a program over parts would compute them again."""
    return jax.tree.map(lambda x: checkpoint_name(x, KEPT), values)


def in_turns(
    function: Callable[..., Any], axis: str, arguments: tuple[Any, ...], divided: Any, outputs: Any
) -> Any:
    """`function(*arguments)` over the parts of its divided arguments, with sums over the axis of
    this name.

    Returns the results; those that are divided have a leading axis of one entry a part. Raises
    ValueError: a result that should be common differs between the parts.

    Args:
        function: of one part; its results are pytrees of arrays.
        axis: name of the axis over which it sums.
        arguments: pytrees of arrays; those that are divided have a leading axis.
        divided: whether each array of the arguments is: a pytree of booleans, or a prefix of one.
        outputs: the same of the results."""
    leaves, tree = jax.tree.flatten(arguments)
    apart = _spread(divided, arguments)
    parts = next(len(x) for x, one in zip(leaves, apart, strict=True) if one)
    given = [jnp.asarray(x) for x in leaves]
    shapes = [
        jax.ShapeDtypeStruct(x.shape[one:], x.dtype) for x, one in zip(given, apart, strict=True)
    ]

    def flat(*each):
        return function(*jax.tree.unflatten(tree, each))

    program, out = jax.make_jaxpr(flat, axis_env=[(axis, parts)], return_shape=True)(*shapes)
    graph = _Graph(axis, parts)
    found = graph.built(program, [given_value(x, one) for x, one in zip(given, apart, strict=True)])
    return jax.tree.unflatten(jax.tree.structure(out), graph.results(found, _spread(outputs, out)))


def _spread(prefix: Any, tree: Any) -> list[bool]:
    """A boolean for every leaf of a pytree."""
    return jax.tree.leaves(
        jax.tree.map(lambda one, below: jax.tree.map(lambda _: one, below), prefix, tree)
    )


class _Graph:
    """The equations of a program, those of called functions among them."""

    def __init__(self, axis: str, parts: int) -> None:
        self._axis = axis
        self._parts = parts

    def built(self, program: Any, inputs: Sequence[Value]) -> list[Value]:
        """The results of a program on these inputs; nothing is computed yet."""
        jaxpr = program.jaxpr
        constants = [given_value(x, False) for x in program.consts]
        known = dict(zip([*jaxpr.constvars, *jaxpr.invars], [*constants, *inputs], strict=True))

        def read(atom):
            return given_value(atom.val, False) if isinstance(atom, Literal) else known[atom]

        for equation in jaxpr.eqns:
            found = self._of(equation, [read(atom) for atom in equation.invars])
            known.update(zip(equation.outvars, found, strict=True))
        return [read(atom) for atom in jaxpr.outvars]

    def _of(self, equation: JaxprEqn, inputs: list[Value]) -> list[Value]:
        name = equation.primitive.name
        params = equation.params
        level = max((one.node.level for one in inputs), default=0)
        divided = [one.divided for one in inputs]
        if name in _CALLS:
            return self.built(params["jaxpr" if "jaxpr" in params else "call_jaxpr"], inputs)
        # a result for each input, common ones of common inputs alone
        if name == "optimization_barrier":
            common_ones = [one for one in inputs if not one.divided]

            def tied(one):
                return [one, *common_ones]

            return [Value(Node(equation, tied(one), level), 0, one.divided) for one in inputs]
        collective = _sums(equation, self._axis)
        node = Node(equation, inputs, level + collective, collective=collective)
        apart = [any(divided)] * len(equation.outvars)
        if name == "while" and collective:
            apart = divided[_constants(params) :]
            beside = divided[params["cond_nconsts"] : _constants(params)]
            while (after := self._divided(params["body_jaxpr"], [*beside, *apart])) != apart:
                apart = [one or other for one, other in zip(after, apart, strict=True)]
        elif name == "cond" and collective and not divided[0]:
            found = [self._divided(branch, divided[1:]) for branch in params["branches"]]
            apart = [any(some) for some in zip(*found, strict=True)]
        elif name in _SUMS and collective:
            apart = [False] * len(equation.outvars)
        elif collective:
            raise NotImplementedError(f"{name} over parts")
        node.divided = apart
        return [Value(node, k, one) for k, one in enumerate(apart)]

    def _divided(self, program: Any, divided: Sequence[bool]) -> list[bool]:
        """Whether each result of a program is divided, on inputs that are or are not."""
        return [
            one.divided for one in self.built(program, [given_value(None, one) for one in divided])
        ]

    def results(self, values: list[Value], divided: Sequence[bool]) -> list[Any]:
        """Values, with a leading axis where they are asked for as divided."""
        wrong = [
            k
            for k, (one, apart) in enumerate(zip(values, divided, strict=True))
            if one.divided and not apart
        ]
        if wrong:
            raise ValueError(f"results {wrong} differ between the parts")
        nodes = nodes_of(values)
        for level in range(1 + max((node.level for node in nodes), default=0)):
            after = [node for node in nodes if node.collective and node.level == level + 1]
            store = [
                Value(node, 0, any(one.divided for one in node.inputs))
                for node in nodes
                if node.is_kept
            ]
            store = [one for one in [*store, *values] if one.node.level == level]
            for node in after:
                store += node.inputs[_constants(node.params) :] if node.name == "while" else []
            self._pass([node for node in after if node.name in _SUMS], store)
            for node in after:
                if node.name in ("while", "cond"):
                    node.stored = dict(
                        enumerate(self._loop(node) if node.name == "while" else self._branch(node))
                    )
        return [self._apart(one, apart) for one, apart in zip(values, divided, strict=True)]

    def _apart(self, value: Value, divided: bool) -> Any:
        """A value that is there or common, with a leading axis if it is asked for."""
        if value.divided:
            return value.get()
        x = common(value)
        return jnp.broadcast_to(x, (self._parts, *jnp.shape(x))) if divided else x

    def _pass(self, sums: list[Node], store: list[Value]) -> None:
        """Computes sums, and stores divided values, in one pass over the parts."""
        store = [one for one in dict.fromkeys(store) if one.divided and not one.there]
        for node in sums:
            if not any(one.divided for one in node.inputs):
                times = self._parts if node.name == "psum" else 1
                node.stored = {k: times * common(one) for k, one in enumerate(node.inputs)}
        sums = [node for node in sums if node.stored is None]
        operands = [one for node in sums for one in node.inputs]
        if not operands and not store:
            return
        given = prepared([*operands, *store])
        arrays = [one.get() for one in given]

        def part(number: Any) -> tuple[list[Any], list[Any]]:
            rows = [lax.dynamic_index_in_dim(x, number, keepdims=False) for x in arrays]
            local = dict(zip(given, rows, strict=True))
            return [inside(one, local) for one in operands], [inside(one, local) for one in store]

        def body(number: Array, carry: tuple[list[Any], list[Any]]) -> tuple[list[Any], list[Any]]:
            # a kernel that also writes into a larger array would run on one core
            found, rows = compute_unfused(part, number, index=number)
            totals = [add(a, b) for add, a, b in zip(adds, carry[0], found, strict=True)]

            def put(every, row):
                return lax.dynamic_update_index_in_dim(every, row, number, 0)

            return totals, [put(every, row) for every, row in zip(carry[1], rows, strict=True)]

        adds = [_SUMS[node.name] for node in sums for _ in node.inputs]
        shapes, kinds = jax.eval_shape(part, jax.ShapeDtypeStruct((), jnp.int32))
        least = [_least(one, add is jnp.maximum) for one, add in zip(shapes, adds, strict=True)]
        empty = [jnp.zeros((self._parts, *one.shape), one.dtype) for one in kinds]
        totals, rows = loops.fori_loop(0, self._parts, body, (least, empty))
        for node in sums:
            node.stored, totals = (
                dict(enumerate(totals[: len(node.inputs)])),
                totals[len(node.inputs) :],
            )
        for one, row in zip(store, rows, strict=True):
            one.node.stored = {**(one.node.stored or {}), one.index: row}

    def _run(self, program: Any, inputs: Sequence[Value], divided: Sequence[bool]) -> list[Any]:
        """The results of a program that is part of another one."""
        return self.results(self.built(program, inputs), divided)

    def _loop(self, node: Node) -> list[Any]:
        """The state after a loop."""
        params = node.params
        beside = node.inputs[: _constants(params)]
        start = node.inputs[_constants(params) :]
        ahead = beside[: params["cond_nconsts"]]
        beside = beside[params["cond_nconsts"] :]
        prepared(node.inputs)

        def state(carry):
            return [given_value(x, apart) for x, apart in zip(carry, node.divided, strict=True)]

        def more(carry):
            return self._run(params["cond_jaxpr"], [*ahead, *state(carry)], [False])[0]

        def body(carry):
            return self._run(params["body_jaxpr"], [*beside, *state(carry)], node.divided)

        return lax.while_loop(
            more, body, [self._apart(*one) for one in zip(start, node.divided, strict=True)]
        )

    def _branch(self, node: Node) -> list[Any]:
        """The results of the branch that is taken."""
        index, *inputs = node.inputs
        prepared(inputs)
        branches = [
            lambda one=one: self._run(one, inputs, node.divided) for one in node.params["branches"]
        ]
        return lax.switch(common(index), branches)


def _least(shape: jax.ShapeDtypeStruct, of_maximum: bool) -> Array:
    """The value with which a sum or a maximum begins."""
    if not of_maximum:
        return jnp.zeros(shape.shape, shape.dtype)
    least = -jnp.inf if jnp.issubdtype(shape.dtype, jnp.floating) else jnp.iinfo(shape.dtype).min
    return jnp.full(shape.shape, least, shape.dtype)


def _constants(params: dict[str, Any]) -> int:
    """Number of inputs of a loop before its state."""
    return params["cond_nconsts"] + params["body_nconsts"]


def _sums(equation: JaxprEqn, axis: str) -> bool:
    """Whether an equation sums over the axis, itself or in what it contains."""
    if axis in equation.params.get("axes", ()):
        return True
    given = [
        x
        for value in equation.params.values()
        for x in (value if isinstance(value, (tuple, list)) else (value,))
    ]
    inner = [getattr(x, "jaxpr", x) for x in given]
    return any(_sums(one, axis) for x in inner if isinstance(x, Jaxpr) for one in x.eqns)
