"""The constant schedule of the paper: the first lambdas of a policy, averaged over test problems."""

from __future__ import annotations

from collections.abc import Sequence

LENGTH = 4
"""Number of values of a schedule. Source: the paper's schedule [1e-15, 1e-15, 0.194, 0.551]."""


def average_schedule(series: Sequence[Sequence[float]], length: int = LENGTH) -> tuple[float, ...]:
    """Arithmetic means of the first lambdas of several solves.

    Args:
        series: lambdas of each solve, in order. A solve that ended earlier does not enter the later means.
        length: number of values; the result is shorter if all solves are.

    Raises:
        ValueError: no solve has a lambda.
    """
    columns = [[row[k] for row in series if len(row) > k] for k in range(length)]
    means = tuple(sum(column) / len(column) for column in columns if column)
    if not means:
        raise ValueError("no solve has a lambda to average")
    return means
