"""Choice of the linear solver, and refusal of what a method does not support or a machine cannot hold."""

from __future__ import annotations

import os
from dataclasses import replace

import jax
import numpy as np

from jaxba.lm.method import check_plain
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.options import LinearSolver, LinearSolverChoice, StepOptions
from jaxba.solver.cost_model import (
    BYTES_PER_OBSERVATION,
    INEXACT_ITERATIONS,
    factoring_bytes,
    most_bytes,
    predict,
)
from jaxba.structure.observation_order import ObservationOrder


def choose(problem: BundleProblem, observations: ObservationOrder | None = None) -> LinearSolver:
    """The linear solver with the lowest predicted time to convergence. Arguments as for `work`."""
    times = {
        name: time if name == "explicit" else INEXACT_ITERATIONS * time
        for name, time in predict(problem, observations)._asdict().items()
    }
    return min(times, key=lambda name: times[name])  # type: ignore[return-value]


def choose_linear_solver(
    problem: BundleProblem,
    options: StepOptions,
    asked: LinearSolverChoice,
    observations: ObservationOrder | None = None,
    devices: int = 1,
) -> StepOptions:
    """The step options with the requested linear solver.

    Args:
        problem: determines the choice of `auto`.
        options: options of the step.
        asked: `auto` or a name. Methods have their own solver.
        observations: the sorted observations of the problem, if they are known already.
        devices: among which observations are divided.

    Raises:
        ProblemError: a method is asked for that does not support the problem; or a step needs more memory than the
            device or the machine has.
    """
    _check_device_memory(problem, devices)
    if options.method:
        lenses = problem.lenses
        shared = lenses is not None and lenses.shared and np.asarray(lenses.free).any()
        check_plain(
            options,
            ProblemError,
            rigs=problem.rigs is not None,
            shared_lenses=bool(shared) and options.intrinsics == "free",
            priors=problem.priors is not None,
        )
        return options
    observations = observations or ObservationOrder.of(problem)
    if asked == "auto":
        return replace(options, linear_solver=choose(problem, observations))  # `choose` respects MAX_BYTES
    if asked == "explicit":
        _check_memory(problem, observations)
    return replace(options, linear_solver=asked)


def device_memory() -> float:
    """Bytes of memory of the default device; infinite if it has none of its own."""
    device = jax.local_devices()[0]
    stats = (device.platform != "cpu" and device.memory_stats()) or {}
    return float(stats.get("bytes_limit", 0)) or np.inf


def _check_device_memory(problem: BundleProblem, devices: int) -> None:
    """Raises a `ProblemError` if the observations alone do not fit the memory of a GPU, whatever the linear solver."""
    available = device_memory()
    needed = 0.5 * BYTES_PER_OBSERVATION * problem.num_observations / devices  # in float32
    if needed > available:
        raise ProblemError(
            f"{problem.num_observations} observations take {2 * needed / 1e9:.1f} GB of a device in float64 and "
            f"{needed / 1e9:.1f} in float32, more than its {available / 1e9:.1f} GB: "
            "divide them among more (--devices) or take the CPU (--device cpu)"
        )


def _check_memory(problem: BundleProblem, observations: ObservationOrder) -> None:
    """Raises a `ProblemError` if a factorisation needs more memory than the machine has."""
    try:
        available = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):
        return
    needed = most_bytes(problem, observations)
    if needed > available:  # an upper bound: count blocks and look for a band
        needed = factoring_bytes(problem, observations)
    if needed > available:
        raise ProblemError(
            f"{problem.num_cameras} cameras take some {needed / 1e9:.0f} GB to "
            f"solve by a factorisation, more than the {available / 1e9:.0f} GB of this machine"
        )
