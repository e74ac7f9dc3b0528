"""Residuals of lenses: bounds, and a weak prior of what lenses are like."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.hold import every_lens, number_columns
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.residuals import Rows, residual

FOCAL, DISTORTION = 0.01, 0.01
"""Standard deviations of the logarithm of a focal length and of each number of distortion. Source: OpenSfM's defaults
`exif_focal_sd` and `radial_distortion_k1_sd`. COLMAP's proposal of such priors (pull request 4683) was
tried with one pixel, and with one over the focal length."""


@residual
def lens_bounds(lens, *, low, high, sigma):
    """A soft barrier at bounds of the numbers of a lens, `low` and `high`, in the order of its camera model, over
    `sigma` (of each, or one for all): two numbers for each.

    With d the excess over `sigma`, a smooth hinge `(d + sqrt(d^2 + 1)) / 2`: 1/2 at the bound, d far beyond it, and
    `1 / (4 |d|)` far inside. Take `sigma` much smaller than the interval. Source: Barron 2021, "Squareplus"."""
    excess = jnp.concatenate([low, -high]) - jnp.concatenate([lens.numbers, -lens.numbers])
    d = (excess.reshape(2, -1) / sigma).ravel()
    root = jnp.sqrt(d * d + 1)
    return jnp.where(d < 0, 0.5 / (root + jnp.abs(d)), 0.5 * (d + root))  # the same number, without cancellation


@residual
def lens_default(lens, *, expected, weight, relative):
    """Differences of the numbers of a lens from expected ones, times a `weight`; where `relative` is 1, of their
    logarithms, for focal lengths (one number each). `lens_defaults` makes the rows."""
    ratio = jnp.where(relative > 0, lens.numbers / jnp.where(relative > 0, expected, 1), 1)
    return weight * jnp.where(relative > 0, jnp.log(ratio), lens.numbers - expected)


def lens_defaults(problem: BundleProblem, *, focal: float = FOCAL, distortion: float = DISTORTION) -> Rows:
    """Rows of a weak prior for all lenses of a problem: focal lengths are about what they are now, distortion is small.

    Args:
        problem: any problem, before it is solved.
        focal: standard deviation of the logarithm of focal lengths.
        distortion: standard deviation of each number of distortion from zero.
    """
    lenses = every_lens(problem)
    used, first = np.unique(lenses.index, return_index=True)
    is_focal, is_distortion = (number_columns(lenses, [name])[used] for name in ("focal", "distortion"))
    expected = np.where(is_focal, np.asarray(problem.cameras)[first, POSE_SIZE:], 0.0)
    return lens_default(
        lens=used, expected=expected, weight=is_focal / focal + is_distortion / distortion, relative=is_focal
    )
