"""Robust losses with Ceres' definitions: `rho(s)` of the squared whitened residual norm `s`.

The cost is `1/2 sum rho(s)`. A loss enters the normal equations as the weight `rho'(s)` (iteratively
reweighted least squares): the second-derivative term of Triggs' correction is left out, which keeps
every block positive semi-definite; the step is a descent direction either way.

Source: Ceres Solver, loss_function.h. `scale` is the residual size, in pixels, where the loss starts to bend.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float


def _squared(s: Array) -> tuple[Array, Array]:
    return s, jnp.ones_like(s)


def _huber(s: Array) -> tuple[Array, Array]:
    outside = s > 1
    root = jnp.sqrt(jnp.where(outside, s, jnp.ones_like(s)))
    return jnp.where(outside, 2 * root - 1, s), 1 / root


def _soft_l1(s: Array) -> tuple[Array, Array]:
    root = jnp.sqrt(1 + s)
    return 2 * (root - 1), 1 / root


def _cauchy(s: Array) -> tuple[Array, Array]:
    return jnp.log1p(s), 1 / (1 + s)


def _tukey(s: Array) -> tuple[Array, Array]:
    rest = jnp.maximum(1 - s, 0)
    value = (1 - rest**3) / 3
    return jnp.where(jnp.isfinite(s), value, s), rest**2  # what is no number is no outlier: it would spoil the step


_SHAPES: dict[str, Callable[[Array], tuple[Array, Array]]] = {
    "squared": _squared,
    "huber": _huber,
    "soft_l1": _soft_l1,
    "cauchy": _cauchy,
    "tukey": _tukey,
}

NAMES = tuple(_SHAPES)
"""Known losses."""


@jax.tree_util.register_static
@dataclass(frozen=True)
class Loss:
    """A loss and its scale (pixels).

    Your own loss is a function `rho(s)` in the place of a name, elementwise in JAX, with `rho(0) = 0` and a derivative
    that is 1 at zero and nowhere negative; JAX differentiates it. Define it once: another function is another program.
    """

    name: str | Callable[[Array], Array] = "squared"
    """One of `squared`, `huber`, `soft_l1`, `cauchy`, `tukey`, or a function of `s / scale^2`."""

    scale: float = 1.0
    """Residual size in pixels at which the loss bends; no effect for `squared`."""

    def __post_init__(self) -> None:
        if not callable(self.name) and self.name not in _SHAPES:
            raise ValueError(f"unknown loss {self.name!r}; known: {', '.join(NAMES)}")
        if not (self.scale > 0 and 0 < self.scale * self.scale < float("inf")):
            raise ValueError(f"scale must be positive, and its square a finite number, is {self.scale}")

    @property
    def trivial(self) -> bool:
        """Whether the weight is one everywhere."""
        return self.name == "squared"

    def __call__(self, squared: Float[Array, "..."]) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """`rho(s)` and `rho'(s)` at squared residual norms, pixels squared."""
        area = self.scale * self.scale
        if callable(self.name):
            value, slope = jax.jvp(self.name, (squared / area,), (jnp.ones_like(squared),))
        else:
            value, slope = _SHAPES[self.name](squared / area)
        return area * value, slope
