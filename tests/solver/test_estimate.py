"""What a solve takes is estimated before it starts, and refused with the arithmetic where it does not fit."""

from __future__ import annotations

import pytest
import support
from support import random_views

import jaxba
from jaxba import ProblemError, SolveOptions, StepOptions
from jaxba.runtime import process
from jaxba.solver import estimate as module
from jaxba.solver.estimate import BYTES_IN_PARTS, BYTES_OF_PROGRAM, BYTES_PER_OBSERVATION, SINGLE, estimate

IMPLICIT = StepOptions(linear_solver="implicit")


def test_observations_that_a_device_cannot_hold_are_refused_with_the_arithmetic(monkeypatch):
    problem = support.tiny()
    needed = BYTES_PER_OBSERVATION * problem.num_observations
    message = r"observations take some .* GB in float64 and .* in float32, and there are .*: take float32"
    for patched, where, more in ((module, "device_memory", 0), (process, "memory", BYTES_OF_PROGRAM)):
        with monkeypatch.context() as patch:
            patch.setattr(patched, where, lambda more=more: needed + more - 1)
            with pytest.raises(ProblemError, match=message):
                jaxba.solve(problem, options=SolveOptions(max_iterations=0))
            estimate(problem, IMPLICIT).check(single=True)
            patch.setattr(patched, where, lambda more=more: SINGLE * needed + more - 1)
            with pytest.raises(ProblemError, match=message):
                estimate(problem, IMPLICIT).check(single=True)
    monkeypatch.setattr(module, "device_memory", lambda: needed - 1)
    estimate(problem, IMPLICIT, devices=2).check(single=False)


def test_parts_and_larger_problems_count():
    small, large = (estimate(random_views(20, points, 0), IMPLICIT) for points in (60, 600))
    assert large.memory > 5 * small.memory
    assert large.iteration_s > small.iteration_s
    in_parts = estimate(random_views(20, 60, 0), IMPLICIT, in_parts=True)
    assert in_parts.memory == pytest.approx(small.memory * BYTES_IN_PARTS / BYTES_PER_OBSERVATION)
    assert not large.is_long


def test_memory_of_the_machine_is_known():
    assert 1e8 < process.memory() < 1e15
