"""What a solve takes is estimated before it starts, and refused with the arithmetic where it does
not fit."""

from __future__ import annotations

import pytest
import support
from support import random_views

import jaxba
from jaxba import ProblemError, SolveOptions, StepOptions
from jaxba.runtime import process
from jaxba.solver import estimate as module
from jaxba.solver.estimate import (
    BYTES_IN_PARTS,
    BYTES_OF_PROGRAM,
    BYTES_PER_OBSERVATION,
    estimate,
    is_long,
    iteration_seconds,
)
from jaxba.structure.observation_order import ObservationOrder


def test_observations_that_a_device_cannot_hold_are_refused_with_the_arithmetic(monkeypatch):
    problem = support.tiny()
    needed = {name: size * problem.num_observations for name, size in BYTES_PER_OBSERVATION.items()}
    message = (
        r"observations take some .* GB in float64 and .* in float32, and there are .*: take float32"
    )
    for patched, where, more in (
        (module, "device_memory", 0),
        (process, "memory", BYTES_OF_PROGRAM),
    ):
        for dtype, size in needed.items():
            with monkeypatch.context() as patch:
                patch.setattr(patched, where, lambda size=size, more=more: size + more - 1)
                with pytest.raises(ProblemError, match=message):
                    jaxba.solve(problem, options=SolveOptions(max_iterations=0, dtype=dtype))
                estimate(problem.num_observations - 1).check(dtype)
    monkeypatch.setattr(module, "device_memory", lambda: needed["float64"] - 1)
    estimate(problem.num_observations, devices=2).check("float64")


def test_parts_take_less_and_larger_problems_take_longer(monkeypatch):
    in_parts = estimate(1000, in_parts=True)
    whole = estimate(1000)
    assert in_parts.memory == {name: 1000 * size for name, size in BYTES_IN_PARTS.items()}
    assert all(in_parts.memory[name] < whole.memory[name] for name in whole.memory)
    orders = [
        ObservationOrder.of(problem)
        for problem in (random_views(20, 60, 0), random_views(20, 600, 0))
    ]
    problem = random_views(20, 600, 0)
    assert iteration_seconds(problem, StepOptions(), orders[1]) == 0  # too few to count their pairs
    monkeypatch.setattr(module, "ANNOUNCED", 0)
    for solver in ("explicit", "sparse", "implicit"):
        small, large = (
            iteration_seconds(problem, StepOptions(linear_solver=solver), order) for order in orders
        )
        assert 0 < small < large
        assert not is_long(large)


def test_memory_of_the_machine_is_known():
    assert 1e8 < process.memory() < 1e15
