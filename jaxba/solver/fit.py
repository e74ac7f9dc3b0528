"""Whether residuals fit their standard deviations: tests with a stated level.

Whitened residuals e of what was measured are independent standard normals if their standard deviations are right. With
the Jacobian J of all residuals, least squares leave

    r = Q e,    Q = I - J (J^T J)^-1 J^T <= I,

so that the squares of n numbers of r exceed any bound less often than those of n normals do.

1. All rows of a kind: `sum |r_i|^2` against the upper quantile of chi^2 with as many degrees of freedom as numbers.
2. The largest row: `max |r_i|^2` against that with as many as the row has, at the level over the number of rows
   (Bonferroni).

The level is that of a solve: with right standard deviations at most one in `1 / LEVEL` has a note.

Source: Baarda 1968, "A testing procedure for use in geodetic networks" (global test and data snooping)."""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Float

LEVEL = 1e-3
"""Probability of a note where standard deviations are right. Source: Baarda 1968, who takes it for data snooping."""


def quantile(degrees: int, level: float) -> float:
    """What chi^2 with some degrees of freedom exceeds with a probability of `level`."""
    from scipy.special import chdtri  # imported late: most solves have no other residuals than pixels

    return float(chdtri(degrees, level))


def too_large(residual: Float[np.ndarray, "rows size"], level: float) -> Bool[np.ndarray, " rows"]:
    """Which rows are larger than standard normals are; half of the level is that of the other test."""
    squares = np.sum(residual**2, axis=1)
    return ~(squares <= quantile(residual.shape[1], level / 2 / len(squares)))


def fits(residual: Float[np.ndarray, "rows size"], level: float) -> bool:
    """Whether rows are standard normals as far as both tests say."""
    together = np.sum(residual**2) <= quantile(residual.size, level / 2)
    return bool(together) and not too_large(residual, level).any()
