"""Settings of JAX and NumPy under which the package computes, whatever the program around it has
set."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import Any, TypeVar, cast

import jax
import numpy as np
from jax.core import Tracer

from jaxba.runtime.process import refuse_fork, single_blas_thread

Function = TypeVar("Function", bound=Callable[..., Any])

TRACED = (  # what is said where JAX traces a function that needs NumPy arrays
    "JAX traces this call (jit, vmap or grad), which is for NumPy problems outside of traces: in "
    "jit and vmap use "
    "jaxba.solve_loop with what jaxba.prepare returned before, for gradients "
    "jaxba.differentiable_solve"
)


@contextmanager
def numerics(dtype: Any, *, single_blas: bool = True) -> Iterator[None]:
    """A context in which programs of the package are traced, compiled and run, with JAX's and
    NumPy's default settings. 64 bits are on unless `dtype`, that of the parameters, is float32;
    `single_blas`: whether LAPACK uses one thread. Raises RuntimeError: the process was forked from
    one in which JAX had started. Raises TypeError: a function that `jax.jit` traces calls this."""
    refuse_fork()
    with ExitStack() as settings:
        settings.enter_context(jax.enable_x64(np.dtype(dtype) != np.float32))
        _set_defaults(settings)
        settings.enter_context(jax.default_matmul_precision(cast(Any, None)))
        settings.enter_context(jax.default_prng_impl("threefry2x32"))
        settings.enter_context(jax.threefry_partitionable(True))
        settings.enter_context(jax.disable_jit(False))
        # steps that overflow are rejected
        for check in (jax.debug_nans, jax.debug_infs, jax.check_tracer_leaks):
            settings.enter_context(check(False))
        settings.enter_context(
            np.errstate(divide="warn", over="warn", under="ignore", invalid="warn")
        )
        # a transfer, which jit traces and compiles nothing
        refuse_traces(jax.device_put(np.zeros(())))
        if single_blas:
            settings.enter_context(single_blas_thread())
        yield


def _set_defaults(settings: ExitStack) -> None:
    """Types and ranks are promoted, and arrays transferred, as by default."""
    settings.enter_context(jax.numpy_dtype_promotion("standard"))
    settings.enter_context(jax.numpy_rank_promotion("allow"))
    settings.enter_context(jax.transfer_guard("allow"))


def for_traces(function: Function) -> Function:
    """Decorates a function of JAX arrays that the program around calls, or traces, under its own
    settings: types and ranks are promoted, and arrays transferred, as by default, and a forked
    process is refused."""

    @functools.wraps(function)
    def with_defaults(*arguments: Any, **named: Any) -> Any:
        refuse_fork()
        with ExitStack() as settings:
            _set_defaults(settings)
            return function(*arguments, **named)

    return cast(Function, with_defaults)


def is_traced(values: Any) -> bool:
    """Whether JAX traces: one of the values, arrays in a pytree, is a tracer."""
    return any(isinstance(value, Tracer) for value in jax.tree.leaves(values))


def refuse_traces(values: Any) -> None:
    """Raises a TypeError if JAX traces these values."""
    if is_traced(values):
        raise TypeError(TRACED)


def check_x64(dtype: Any) -> None:
    """Raises a ValueError if arrays of this type would silently become float32."""
    if np.dtype(dtype) == np.float64 and not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]
        raise ValueError(
            'float64 needs 64 bits in JAX: call jax.config.update("jax_enable_x64", True) first'
        )
