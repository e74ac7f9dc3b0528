"""Power bundle adjustment (PoBA): a power series for the inverse of the reduced camera system.

With `S = B - W`, where B are the damped camera blocks,

    S^-1 b = sum_i (B^-1 W)^i B^-1 b.

A term takes a product with S and one with the inverses of the 9 x 9 blocks, but no inner products.

Source: Weber et al. 2023, "Power Bundle Adjustment for Large-Scale 3D Reconstruction".
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from jaxba.linear.preconditioners import block_inverse
from jaxba.linear.schur import CameraSystem, DampedSystem, apply_reduced
from jaxba.lm.method import MethodStep, StepMethod
from jaxba.problem.options import StepOptions, check_count
from jaxba.runtime import loops


@dataclass(frozen=True)
class PowerSeries(StepMethod):
    """The method `poba`."""

    order: int = 20
    """Order of the series: the highest power. Source: Weber et al. 2023, section 5."""

    name = "poba"

    def __post_init__(self) -> None:
        check_count("order", self.order, 0)

    def solve(self, system: DampedSystem, options: StepOptions) -> MethodStep:
        """See `StepMethod`."""
        product = lambda x: apply_reduced(system, x)
        inverse = block_inverse(system.cameras.blocks)
        step = series(product, system.cameras, inverse, system.cameras.right, self.order)
        return MethodStep(step, None, jnp.asarray(self.order, jnp.int32), residual_orthogonal=False)


def series(
    apply: Callable[[Array], Array],
    system: CameraSystem,
    inverse: Callable[[Array], Array],
    right: Float[Array, "cameras width"],
    order: int,
) -> Float[Array, "cameras width"]:
    """The first `order + 1` terms of `sum_i (B^-1 W)^i B^-1 b`, a symmetric linear map of b.

    Args:
        apply: product with S.
        system: damped camera blocks B.
        inverse: product with B^-1.
        right: b.
        order: highest power.
    """

    def body(_: Array, carry: tuple[Array, Array]) -> tuple[Array, Array]:
        total, term = carry
        term = inverse(jnp.einsum("cab,cb->ca", system.blocks, term) - apply(term))
        return total + term, term

    start = inverse(right)
    return loops.fori_loop(0, order, body, (start, start))[0]
