"""What JAX's errors about a user's function mean, in one line."""

from __future__ import annotations

import jax

_ADVICE: tuple[tuple[type[Exception], str], ...] = (
    (
        jax.errors.TracerBoolConversionError,
        "it decides in Python (if, and, or, not, while) by a number that is computed: "
        "use jnp.where, & or |",
    ),
    (jax.errors.TracerArrayConversionError, "it calls NumPy: use jax.numpy"),
    (
        jax.errors.ConcretizationTypeError,
        "it needs a computed number in Python (float(), int(), math): use jax.numpy",
    ),
)
"""Errors of JAX and what to do, the special ones before those that they are kinds of."""


def advice(error: Exception) -> str:
    """What is wrong with a function that JAX could not trace, in one line."""
    for kind, text in _ADVICE:
        if isinstance(error, kind):
            return text
    return " ".join(str(error).split()) or type(error).__name__
