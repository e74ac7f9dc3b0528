"""How many cameras see each point: a distribution of track lengths with an exact sum."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from jaxtyping import Int

TAIL_EXPONENT = 1.4
"""Exponent a of the power law. Maximum-likelihood fits gave 1.29 on BAL's Trafalgar-21, 1.33 on
stereo odometry of KITTI 00 and 1.54 on BAL's Ladybug-49; the cut-off b follows from the mean."""

MIN_LENGTH = 2  # views that determine the position of a point


@lru_cache(maxsize=64)
def track_lengths(points: int, observations: int, longest: int) -> Int[np.ndarray, " points"]:
    """Numbers of views of so many points, longest first, that add up to `observations`; read-only.

    A truncated power law with exponential cut-off, `p(k) ~ k^-a exp(-b k)` for 2 <= k <= longest.
    Lengths are not drawn: each occurs as often as is expected, so that the histogram has no
    noise."""
    sizes = np.arange(MIN_LENGTH, longest + 1)
    share = _shares(sizes, observations / points)
    lengths = np.repeat(sizes[::-1], _round_counts(points * share)[::-1])
    rest = observations - int(lengths.sum())
    while rest:
        movable = np.flatnonzero(lengths < longest if rest > 0 else lengths > MIN_LENGTH)
        picked = movable[np.linspace(0, movable.size - 1, min(abs(rest), movable.size)).astype(int)]
        lengths[picked] += np.sign(rest)
        rest -= int(np.sign(rest)) * picked.size
    lengths = np.sort(lengths)[::-1].astype(np.int32)
    lengths.setflags(write=False)
    return lengths


def _shares(sizes: np.ndarray, mean: float) -> np.ndarray:
    """Probabilities of the sizes, with the cut-off found by bisection so that their mean is
    `mean`."""

    def shares(cutoff: float) -> np.ndarray:
        logarithm = -TAIL_EXPONENT * np.log(sizes) - cutoff * (sizes - MIN_LENGTH)
        weight = np.exp(logarithm - logarithm.max())
        return weight / weight.sum()

    low, high = -60.0, 60.0  # exp(-60) makes either end of the sizes certain to float64 precision
    for _ in range(60):  # halves the interval down to rounding
        middle = (low + high) / 2
        low, high = (middle, high) if shares(middle) @ sizes > mean else (low, middle)
    return shares((low + high) / 2)


def _round_counts(expected: np.ndarray) -> np.ndarray:
    """Integers next to `expected` with the same (integer) sum: largest remainders are rounded
    up."""
    counts = np.floor(expected).astype(np.int64)
    missing = round(float(expected.sum())) - int(counts.sum())
    counts[np.argsort(counts - expected, kind="stable")[:missing]] += 1
    return counts
