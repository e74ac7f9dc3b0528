"""What a solve takes: memory, refused where it does not suffice, and seconds, told before a long one."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.options import StepOptions
from jaxba.runtime import process
from jaxba.solver.choose import seconds, work
from jaxba.structure.observation_order import ObservationOrder

BYTES_PER_OBSERVATION = 1100.0
"""Memory of one implicit step in float64: arguments, results and temporaries. Measured: 1,072 on a scene of the size of
Ladybug-1197."""

BYTES_IN_PARTS = 420.0
"""The same of a process that computes in parts (sharded.py), with the problem. Measured: 386 on a scene of the size of
Final-13682, `python -m benchmarks.growth --sizes 28988`."""

BYTES_OF_PROGRAM = 0.7e9  # of Python, JAX and the compilation of a step
SINGLE = 0.6  # share in float32 of what is not that

ITERATIONS = 10  # of a solve, assumed
LONG_S = 10.0  # seconds of a solve that is announced


class Estimate(NamedTuple):
    """Of one solve."""

    observations: int
    """Number of observations."""

    memory: float
    """Bytes that the observations take on a device in float64, or in this process on a CPU."""

    available: float
    """Bytes that it has for them; infinite if that is not known."""

    iteration_s: float
    """Seconds of an iteration on a machine like that of `choose.SECONDS`."""

    @property
    def is_long(self) -> bool:
        """Whether the solve is worth an announcement."""
        return ITERATIONS * self.iteration_s > LONG_S

    def check(self, *, single: bool) -> None:
        """Raises a ProblemError with the arithmetic if the memory does not suffice, in float32 if `single`."""
        needed = self.memory * (SINGLE if single else 1)
        if needed > self.available:
            raise ProblemError(
                f"{self.observations} observations take some {self.memory / 1e9:.1f} GB in float64 and "
                f"{SINGLE * self.memory / 1e9:.1f} in float32, and there are {self.available / 1e9:.1f}: take float32 "
                "(--dtype) if that fits, more devices or processes, or fewer points"
            )

    def __str__(self) -> str:
        return (
            f"{self.observations} observations: some {self.memory / 1e9:.2g} GB of {self.available / 1e9:.2g}, and "
            f"{self.iteration_s:.2g} s an iteration"
        )


def estimate(
    problem: BundleProblem,
    options: StepOptions,
    *,
    observations: ObservationOrder | None = None,
    devices: int = 1,
    in_parts: bool = False,
) -> Estimate:
    """Of a solve with these options, divided among devices, each of which computes part by part or not. `observations`
    are the sorted ones of the problem, if they are known already."""
    on_gpu, count = device_memory(), len(problem.observations)
    each = BYTES_IN_PARTS if in_parts else BYTES_PER_OBSERVATION
    amounts = work(problem, observations=observations)
    chosen = amounts.get(options.linear_solver, amounts["implicit"])
    if np.isfinite(on_gpu):
        return Estimate(count, each * count / devices, on_gpu, seconds(chosen))
    available = process.memory() - BYTES_OF_PROGRAM
    return Estimate(count, each * count / jax.process_count(), available, seconds(chosen))


def device_memory() -> float:
    """Bytes of memory of the default device; infinite if it has none of its own."""
    device = jax.local_devices()[0]
    stats = (device.platform != "cpu" and device.memory_stats()) or {}
    return float(stats.get("bytes_limit", 0)) or np.inf
