"""Robust losses `rho(s)` of the squared whitened residual norm s, as defined by Ceres.

    f = 1/2 sum_i rho(|r_i|^2)

In the normal equations residual and Jacobian are weighted by `sqrt(rho'(s))` (iteratively
reweighted least squares). The second-derivative term of Triggs' correction is left out, so that
every block stays positive semi-definite.

Source: Ceres Solver, loss_function.h; Triggs et al. 2000, "Bundle Adjustment - A Modern
Synthesis"."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.problem.checks import finite, shown


def _huber(s: Array) -> tuple[Array, Array]:
    outside = s > 1
    root = jnp.sqrt(jnp.where(outside, s, jnp.ones_like(s)))
    return jnp.where(outside, 2 * root - 1, s), 1 / root


def _soft_l1(s: Array) -> tuple[Array, Array]:
    root = jnp.sqrt(1 + s)
    return s * (2 / (1 + root)), 1 / root  # 2 (root - 1) without cancellation


def _tukey(s: Array) -> tuple[Array, Array]:
    inside = jnp.minimum(s, 1)
    value = inside * (1 - inside + inside**2 / 3)  # (1 - (1 - s)^3) / 3 without cancellation
    # nan and inf must not pass as outliers
    return jnp.where(jnp.isfinite(s), value, s), (1 - inside) ** 2


_SHAPES: dict[str, Callable[[Array], tuple[Array, Array]]] = {
    "squared": lambda s: (s, jnp.ones_like(s)),
    "huber": _huber,
    "soft_l1": _soft_l1,
    "cauchy": lambda s: (jnp.log1p(s), 1 / (1 + s)),
    "tukey": _tukey,
}

NAMES = tuple(_SHAPES)  # names of the known losses


@jax.tree_util.register_static
@dataclass(frozen=True)
class Loss:
    """A robust loss and its scale (pixels).

    Instead of a name you can give a function `rho(s)`, elementwise in JAX, with `rho(0) = 0`,
    derivative 1 at zero and no negative derivative; JAX differentiates it. Define the function
    once: another function object compiles again."""

    rho: str | Callable[[Array], Array] = "squared"
    """One of `squared`, `huber`, `soft_l1`, `cauchy`, `tukey`, or a function of `s / scale^2`."""

    scale: float = 1.0
    """Residual norm in pixels at which the loss starts to flatten; no effect for `squared`."""

    def __post_init__(self) -> None:
        if not callable(self.rho) and not (isinstance(self.rho, str) and self.rho in _SHAPES):
            raise ValueError(f"unknown loss {shown(self.rho)}; known: {', '.join(NAMES)}")
        scale = float(finite("scale", self.scale, ()))
        if not (scale > 0 and 0 < scale * scale < float("inf")):
            raise ValueError(
                f"scale must be positive, and its square a finite number, is {self.scale}"
            )

    @property
    def trivial(self) -> bool:
        """Whether this is the squared loss, with weight one everywhere."""
        return self.rho == "squared"

    def __call__(
        self, squared: Float[Array, "..."]
    ) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
        """`rho(s)` (pixels^2) and `rho'(s)` at squared residual norms s (pixels^2)."""
        area = self.scale * self.scale
        if callable(self.rho):
            value, slope = jax.jvp(self.rho, (squared / area,), (jnp.ones_like(squared),))
            if value.shape != squared.shape:
                raise ValueError(
                    f"a loss is elementwise: {shown(self.rho)} of shape {squared.shape} gave "
                    f"{value.shape}"
                )
        else:
            value, slope = _SHAPES[self.rho](squared / area)
        return area * value, slope
