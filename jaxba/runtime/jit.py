"""`jax.jit` with the options of XLA without which programs may compute wrong numbers.

From jaxlib 0.10.2 on XLA gives products and sums of a program on a CPU to YNNPACK, and some of them
come back wrong without a word: `vmap(lambda x: jnp.sum((M @ x) ** 2))` from 16,385 rows on, in
jaxlib 0.10.2 (jax-ml/jax#39103); others crash (#39257). `tests/runtime/test_jit.py` shows on which
versions this still is so."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any

import jax
from jax._src.core import trace_state_clean  # it has no public name

Options = dict[str, bool | int | str]

# of all programs on a CPU: no fusions for YNNPACK
RIGHT: Options = {"xla_cpu_experimental_ynn_fusion_type": ""}
# 0.12 lacks the latter
QUICK: Options = {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False}


@functools.cache
def quick_options() -> Options:
    """The options of `QUICK` that this jaxlib knows; none on a GPU."""
    return known_options(QUICK) if jax.default_backend() == "cpu" else {}


@functools.cache
def right_options() -> Options:
    """The options of `RIGHT` that this jaxlib knows; none on a GPU."""
    return known_options(RIGHT) if jax.default_backend() == "cpu" else {}


def known_options(options: Options) -> Options:
    """Those of XLA's options that this jaxlib knows."""
    if not options or _are_known(options):
        return dict(options)
    return {name: value for name, value in options.items() if _are_known({name: value})}


def _are_known(options: Options) -> bool:
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:
        return False
    return True


class jit:
    """`jax.jit`, compiled with `right_options`.

    JAX takes options for whole programs: what is called inside another one, or a transformation,
    has its options."""

    def __init__(
        self, function: Callable[..., Any], *, once: bool = False, **settings: Any
    ) -> None:
        """`function` is what it computes, `settings` are those of `jax.jit`. What runs `once` is
        hardly optimised."""
        functools.update_wrapper(self, function)
        self._part = jax.jit(function, **settings)
        self._settings = settings
        self._once = once

    @functools.cached_property
    def _whole(self) -> Any:  # only now: JAX's backend must not start when a module is imported
        options = right_options() | (quick_options() if self._once else {})
        return jax.jit(self.__wrapped__, compiler_options=options, **self._settings)

    def __call__(self, *arguments: Any, **named: Any) -> Any:
        return (self._whole if trace_state_clean() else self._part)(*arguments, **named)

    def __getattr__(self, name: str) -> Any:
        """`lower`, `trace` and whatever else a function of `jax.jit` has."""
        if name.startswith("__"):
            raise AttributeError(name)
        return getattr(self._whole, name)
