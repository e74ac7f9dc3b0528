"""What a solve takes: memory, refused where it does not suffice, and seconds, told before a long
one."""

from __future__ import annotations

from typing import NamedTuple

import jax
import numpy as np

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.options import StepOptions
from jaxba.runtime import process
from jaxba.solver.choose import implicit_work, seconds, work
from jaxba.structure.observation_order import ObservationOrder

BYTES_PER_OBSERVATION = {"float64": 1100.0, "float32": 605.0}
"""Memory of one implicit step: arguments, results and temporaries. Measured: 1,072 in float64 on a
scene of the size of Ladybug-1197."""

BYTES_IN_PARTS = {"float64": 420.0, "float32": 280.0}
"""The same of a process that computes in parts (sharded.py), with the problem and what its set-up
needs. Measured: 362 on a scene of the size of Final-13682 in float64, 258 on one of 9.1 million in
float32 (`python -m benchmarks.growth`). """

SECONDS_IN_PARTS = 2.0
"""Seconds of an iteration in parts, relative to those of `choose.SECONDS`, which were fitted to
smaller problems. Measured from 1 to 29 million observations: 1.5 to 2.1 with rule `ceres`, 2.5 to
4.2 with `guarded` until convergence (`python -m benchmarks.growth`)."""

BYTES_OF_PROGRAM = 0.7e9  # of Python, JAX and the compilation of a step
ITERATIONS = 10  # of a solve, assumed
LONG_S = 10.0  # seconds of a solve that is announced
ANNOUNCED = 100_000  # observations from which on a solve may be long


class Estimate(NamedTuple):
    """What the observations of a problem take."""

    observations: int
    """Number of observations."""

    memory: dict[str, float]
    """Bytes on a device, or in this process on a CPU, in float64 and float32."""

    available: float
    """Bytes that there are for them; infinite if that is not known."""

    def check(self, dtype: str) -> None:
        """Raises a ProblemError with the arithmetic if the memory does not suffice in this type of
        numbers."""
        if self.memory[dtype] > self.available:
            double, single = (self.memory[name] / 1e9 for name in ("float64", "float32"))
            raise ProblemError(
                f"{self.observations} observations take some {double:.1f} GB in float64 and "
                f"{single:.1f} in float32, "
                f"and there are {self.available / 1e9:.1f}: take float32 (--dtype) if that fits, "
                "more devices or "
                "processes, or fewer points"
            )

    def told(self, dtype: str, iteration_s: float) -> str:
        """In words, with the seconds of an iteration."""
        memory = f"some {self.memory[dtype] / 1e9:.2g} GB of {self.available / 1e9:.2g}"
        return f"{self.observations} observations: {memory}, and {iteration_s:.2g} s an iteration"


def estimate(observations: int, *, devices: int = 1, in_parts: bool = False) -> Estimate:
    """What so many observations take, divided among devices, each of which computes part by part or
    not."""
    on_gpu = device_memory()
    each = BYTES_IN_PARTS if in_parts else BYTES_PER_OBSERVATION
    share = devices if np.isfinite(on_gpu) else jax.process_count()
    available = on_gpu if np.isfinite(on_gpu) else process.memory() - BYTES_OF_PROGRAM
    return Estimate(
        observations, {name: size * observations / share for name, size in each.items()}, available
    )


def iteration_seconds(
    problem: BundleProblem,
    options: StepOptions,
    observations: ObservationOrder,
    *,
    in_parts: bool = False,
) -> float:
    """Of an iteration with these options, in parts or not, on a machine like that of
    `choose.SECONDS`; zero for few observations, which are not worth the count of their pairs."""
    if len(observations.order) < ANNOUNCED:
        return 0.0
    if options.linear_solver == "implicit":
        return (SECONDS_IN_PARTS if in_parts else 1.0) * seconds(
            implicit_work(len(observations.order))
        )
    amounts = work(problem, observations=observations)
    return seconds(amounts.get(options.linear_solver, amounts["implicit"]))


def is_long(iteration_s: float) -> bool:
    """Whether a solve is worth an announcement."""
    return ITERATIONS * iteration_s > LONG_S


def device_memory() -> float:
    """Bytes of memory of the default device; infinite if it has none of its own."""
    device = jax.local_devices()[0]
    stats = (device.platform != "cpu" and device.memory_stats()) or {}
    return float(stats.get("bytes_limit", 0)) or np.inf
