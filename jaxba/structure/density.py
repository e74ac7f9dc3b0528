"""When the reduced camera system is formed by one dense matrix product instead of from pairs of
observations.

Two cases: nearly every camera sees nearly every point, or there are few points (calibration boards,
hand-set markers), where Woodbury's identity replaces the system by one of the size of the points
(linear/woodbury.py)."""

from __future__ import annotations

from jaxba.structure.observation_order import ObservationOrder

# least pairs, per point and cameras squared, for a dense product: 17 times as fast per operation
MIN_DENSITY = 0.1
# largest system formed by a dense product, and largest capacitance matrix of Woodbury's identity
DENSE_UNKNOWNS = 512
# most point coordinates per camera unknown for Woodbury's identity: 0.7 alone, 0.85 in batches
MAX_POINT_RATIO = 2 / 3


def has_few_points(points: int, cameras: int) -> bool:
    """Whether points, including padding, are few enough relative to cameras for Woodbury's identity
    to be cheaper."""
    return 3 * points <= MAX_POINT_RATIO * 9 * cameras


def has_small_capacitance(columns: int, cameras: int) -> bool:
    """Whether, in addition, the capacitance matrix is so small that it pays however few
    observations there are."""
    return 3 * columns <= DENSE_UNKNOWNS and has_few_points(columns, cameras)


def is_dense(observations: ObservationOrder, cameras: int, columns: int) -> bool:
    """Whether one dense product is cheaper than listed pairs. Impossible if a camera sees a point
    twice. The numbers of cameras and of columns, points in layout order, include padding."""
    pairs = observations.num_pairs
    points = observations.num_observed_points
    dense = 9 * cameras <= DENSE_UNKNOWNS and pairs > MIN_DENSITY * points * cameras**2
    return (
        dense or has_small_capacitance(columns, cameras)
    ) and not observations.num_repeated_pairs
