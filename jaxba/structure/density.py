"""Whether the reduced camera system is better made of one dense product than of chosen pairs of observations."""

from __future__ import annotations

import numpy as np

DENSE_SHARE = 0.1
"""Pairs per point and pair of cameras from which on a dense product forms the system: it runs 17 times as fast an
operation as the products of chosen pairs, and doubles each of them."""

DENSE_UNKNOWNS = 512
"""Larger systems are formed from pairs, but where points are few: the dense operand takes 72 bytes a point and unknown.
It is the most columns of a capacitance matrix besides, which LAPACK factors in a millisecond."""

LARGEST_SHARE = 2 / 3
"""Coordinates of points over unknowns of cameras up to which the capacitance matrix is the cheaper one: of 10 or 40
cameras alone the time of both was equal near 0.7, in batches of 256 scenes near 0.85."""


def has_few_points(points: int, cameras: int) -> bool:
    """Whether the points, padding included, are few enough beside the cameras for `capacitance_solve`."""
    return 3 * points <= LARGEST_SHARE * 9 * cameras


def has_small_capacitance(columns: int, cameras: int) -> bool:
    """Whether, moreover, they are so few that their matrix is the whole cost, whoever sees them."""
    return 3 * columns <= DENSE_UNKNOWNS and has_few_points(columns, cameras)


def has_dense_shape(tracks: np.ndarray, cameras: int, columns: int) -> bool:
    """`is_dense`, as far as lengths of tracks tell it: if no camera sees a point twice.

    Args:
        tracks: observations of each point.
        cameras: number of cameras.
        columns: points in layout order, padding included.
    """
    pairs = float(np.sum(tracks * (tracks + 1.0)) / 2)
    dense = 9 * cameras <= DENSE_UNKNOWNS and pairs > DENSE_SHARE * np.count_nonzero(tracks) * cameras**2
    return bool(dense or has_small_capacitance(columns, cameras))


def is_dense(camera: np.ndarray, point: np.ndarray, tracks: np.ndarray, cameras: int, columns: int) -> bool:
    """Whether one dense product is cheaper than chosen pairs.

    So it is where nearly every camera sees nearly every point; and where there are few points in all, such as the
    corners of a calibration board or hand-set markers, whoever sees them.

    Args:
        camera: of each observation, sorted by point, then by camera.
        point: of each observation.
        tracks: observations of each point.
        cameras: number of cameras.
        columns: points in layout order, padding included.
    """
    if not has_dense_shape(tracks, cameras, columns):
        return False
    return not np.any((camera[1:] == camera[:-1]) & (point[1:] == point[:-1]))
