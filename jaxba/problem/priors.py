"""Priors: what is known of cameras besides the pixels, with its uncertainty.

    f = 1/2 sum_i rho(|r_i|^2) + 1/2 sum_c rho_p(|W_c (C_c - p_c)|^2) + 1/2 sum_c |V_c log(R_c Q_c^T)|^2
                               + 1/2 sum_l |(y_l - m_l) / s_l|^2

with the centre `C = -R^T t` of a camera and its measured position p (GPS), its rotation R and a measured one Q, and the
numbers y of a lens with their means m and standard deviations s. W and V are inverse square roots of covariances.

Source: COLMAP, `CovarianceWeightedCostFunctor<AbsolutePosePositionPriorCostFunctor>` for positions.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

from jaxtyping import Float

from jaxba.problem.checks import finite, shown
from jaxba.problem.losses import Loss
from jaxba.typing import AnyArray, ArrayRecord, register_pytree


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Priors(ArrayRecord):
    """Priors of a problem, in the order of its cameras and lenses. Zero weights are for what nothing is known of."""

    positions: Float[AnyArray, "cameras 3"]
    """Measured centres, scene units."""

    position_whitening: Float[AnyArray, "cameras 3 3"]
    """`Sigma^(-1/2)` of each, 1 / scene units."""

    rotations: Float[AnyArray, "cameras 3"]
    """Measured rotations, angle-axis, from the world to BAL's camera, radians."""

    rotation_whitening: Float[AnyArray, "cameras 3 3"]
    """`Sigma^(-1/2)` of each in the camera's frame, 1 / radians."""

    lenses: Float[AnyArray, "lenses numbers"]
    """Expected numbers of lenses."""

    lens_weight: Float[AnyArray, "lenses numbers"]
    """Inverse standard deviations."""

    position_loss: Loss = field(default_factory=Loss, metadata={"static": True})
    """Robust loss of the squared whitened distance from a measured position."""


def checked_priors(priors: Priors, cameras: int, lenses: int, numbers: int) -> Priors:
    """Checks the priors of so many cameras, and lenses of so many numbers, and returns them as float64 NumPy arrays.
    Raises ValueError: a shape differs, or something is not finite; one line."""
    shapes = {
        "positions": (cameras, 3),
        "position_whitening": (cameras, 3, 3),
        "rotations": (cameras, 3),
        "rotation_whitening": (cameras, 3, 3),
        "lenses": (lenses, numbers),
        "lens_weight": (lenses, numbers),
    }
    if not isinstance(priors.position_loss, Loss):
        raise ValueError(f"position_loss of priors must be a jaxba.Loss, not {shown(priors.position_loss)}")
    arrays = {name: finite(f"{name} of priors", getattr(priors, name), shape) for name, shape in shapes.items()}
    return replace(priors, **arrays)
