"""The timing of a solve to a tolerance, as `python -m benchmarks.suite --only tolerance` does
it."""

from __future__ import annotations

import pytest
import support

from benchmarks import suite
from jaxba.problem import geometry


def test_a_solve_to_a_target_ends_there_and_without_one_at_the_minimum():
    problem = support.tiny()
    least, seconds = suite._cost_and_seconds(problem, "ceres")
    assert seconds > 0
    assert least == pytest.approx(geometry.cost(support.solve(problem, "ceres").problem))
    target = 2 * least
    reached, _ = suite._cost_and_seconds(problem, "ceres", target)
    assert least < reached <= target
