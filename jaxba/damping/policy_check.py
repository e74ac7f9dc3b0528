"""Whether a user's damping policy can be compiled, said in one line before anything is compiled."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping.policy import DampingPolicy, ProblemInfo
from jaxba.lm.records import StepInfo
from jaxba.runtime.numerics import numerics
from jaxba.runtime.trace_errors import advice

LONGEST = 200  # characters of a message that is passed on

_checked: set[type[Any]] = set()
"""Classes of policies that have been checked."""


def check_traceable(policy: DampingPolicy) -> None:
    """Checks that JAX can trace a policy's `init` and `propose`, and that the state keeps its
    structure and shapes. Nothing is compiled; a class is checked once. Raises ValueError, whose one
    line names the function."""
    kind = type(policy)
    if kind in _checked or kind.__module__.partition(".")[0] == "jaxba":
        return
    with numerics(np.float64):
        number = jax.ShapeDtypeStruct((), jnp.result_type(float))
        count = jax.ShapeDtypeStruct((), jnp.int32)
        flag = jax.ShapeDtypeStruct((), bool)
        counts = {"observations", "cameras", "points", "max_iterations", "cg_iterations", "repairs"}
        flags = {"accepted", "weightless"}

        def example(record: type[Any]) -> Any:
            """The record with a shape and type for each field."""
            kinds = (
                count if name in counts else flag if name in flags else number
                for name in record._fields
            )
            return record(*kinds)

        state, damping = _traced(policy, "init", policy.init, example(ProblemInfo))
        _check_damping(policy, "init", damping)
        after, damping = _traced(policy, "propose", policy.propose, state, example(StepInfo))
        _check_damping(policy, "propose", damping)
    shapes = [
        (jax.tree.structure(tree), [x.shape for x in jax.tree.leaves(tree)])
        for tree in (state, after)
    ]
    if shapes[0] != shapes[1]:
        raise ValueError(
            f"policy {type(policy).__name__}: propose must return a state like that of init, "
            f"{_outline(state)}, not {_outline(after)}"
        )
    _checked.add(kind)


def _traced(
    policy: DampingPolicy, name: str, function: Callable[..., Any], *arguments: Any
) -> tuple[Any, Any]:
    """Shapes and types of the state and lambda that a function of a policy returns."""
    where = f"policy {type(policy).__name__}: {name}"
    try:
        result = jax.eval_shape(function, *arguments)
    except Exception as error:
        reason = textwrap.shorten(advice(error), LONGEST)
        raise ValueError(f"{where} cannot be compiled: {reason}") from error
    if not isinstance(result, tuple) or len(result) != 2:
        raise ValueError(f"{where} must return a state and lambda, not {_outline(result)}")
    return result


def _check_damping(policy: DampingPolicy, name: str, damping: Any) -> None:
    if getattr(damping, "shape", None) != ():
        raise ValueError(
            f"policy {type(policy).__name__}: {name} must return lambda as a number, "
            f"not {_outline(damping)}"
        )


def _outline(tree: Any) -> str:
    """Structure and shapes, for a message."""
    shapes = jax.tree.map(lambda x: f"{x.dtype}{list(x.shape)}", tree)
    return textwrap.shorten(str(shapes), LONGEST)
