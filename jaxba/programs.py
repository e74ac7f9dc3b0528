"""How XLA compiles programs on a CPU: with all optimisation, or in a third of the time.

Compiling takes longer than most solves. A program made without LLVM's optimisation, and without XLA's newer kernel
emitters, whose kernels LLVM takes longest for, computes the same to rounding, but two to six times as slowly
(`python -m benchmarks.compilation`, docs/performance.md). So who has one problem to solve starts with it, and pays for
the optimised program only where so many iterations come that it would have been cheaper from the start: as with skis
that may be rented or bought, that is never much dearer than the better of the two.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, Literal, TypeVar, cast, get_args

import jax

Function = TypeVar("Function", bound=Callable[..., Any])
Result = TypeVar("Result")

Compilation = Literal["full", "quick", "auto"]
"""`full`: all optimisation. `quick`: hardly any. `auto`: quick, and full after as many iterations as pay for it."""

COMPILATIONS: tuple[str, ...] = get_args(Compilation)

QUICK = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}
"""XLA's options for a quick compilation. Level 0 alone saves half as much and makes loops twice as slow."""

REPAID = 2_000_000
"""Observations times iterations after which the optimised program has paid for its compilation: it took 4 to 8 s longer
to compile and 1.1e-6 to 4.4e-6 s less for an observation in an iteration, on nine problems, all on the same machine
(`python -m benchmarks.compilation`)."""

FEWEST = 20
"""Where the optimised program pays within so few iterations it is compiled at once, since many solves take as many:
`learned` converges within 3 to 98 on the fifteen real problems, within fewer than 20 on eleven of them."""


def quick_iterations(observations: int) -> int:
    """How many iterations of a problem are computed by a quickly compiled program before the optimised one is made."""
    count = REPAID // max(1, observations)
    return count if count >= FEWEST else 0


@functools.cache
def quick_options() -> dict[str, bool | int] | None:
    """XLA's options for a quick compilation; None where there is no such thing, on a GPU or in another jaxlib."""
    if jax.default_backend() != "cpu":
        return None
    options: dict[str, bool | int] = dict(QUICK)
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:  # an option that it does not know
        return None
    return options


@functools.cache
def program(function: Callable[..., Result], *static: str, quick: bool = False) -> Callable[..., Result]:
    """The function compiled, one program for each way of compiling.

    Args:
        function: what it computes.
        static: names of its static arguments.
        quick: hardly optimised, if that can be had.
    """
    options: Any = quick_options() if quick else None
    return jax.jit(function, static_argnames=static, compiler_options=options)


def traced_once(*static: str) -> Callable[[Function], Function]:
    """Decorates what a program contains several times: traced once for arguments of equal types, and called.

    XLA inlines the calls, so that the program is the same; two fifths of the time to trace a step went into copies.

    Args:
        static: names of its static arguments.
    """
    return lambda function: cast(Function, jax.jit(function, static_argnames=static))
