"""The record of a solve: what `jaxba-solve --log` writes, and a line of `results.jsonl`.

`io/json_lines.py` writes it. The keys are the field names below, except that `TracePoint.damping`
is written as `"lambda"`, a reserved word in Python. They must not change, since other tools and old
result files rely on them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from importlib.metadata import version

import jax
import numpy as np

from jaxba.runtime.process import threads
from jaxba.solver.drivers import IterationRecord
from jaxba.solver.names import SolverName
from jaxba.solver.solve import Solution


@dataclass(frozen=True)
class TracePoint:
    """State after one iteration, accepted or rejected. The first point of a trace is the start."""

    iteration: int
    """Number of linear solves so far; 0 is the start."""

    time_s: float
    """Seconds since the start of the solve, without compilation."""

    cost: float
    """Accepted cost after this iteration, `1/2 sum rho` in pixels squared; unchanged by a rejected
    step."""

    damping: float = field(metadata={"key": "lambda"})
    """Lambda of this iteration, dimensionless; written as `"lambda"`. NaN where unknown."""

    accepted: bool
    """Whether the step was accepted."""

    cg_iterations: int
    """Conjugate gradient iterations of this linear solve; 0 for a direct solver."""

    gain_ratio: float
    """Actual over predicted decrease of the cost. NaN where there was no step, e.g. after a failed
    factorisation."""


@dataclass(frozen=True)
class Record:
    """One run of one solver on one problem."""

    problem: str
    """Name, the same for every solver of the problem."""

    family: str
    """Group of problems, e.g. ladybug."""

    cameras: int
    """Number of cameras."""

    points: int
    """Number of points."""

    observations: int
    """Number of observations."""

    solver: str
    """Name, `[method+]policy[+refineK|+embedded][@dtype]`, or that of another library, e.g.
    `pyceres:dense`."""

    backend: str
    """Library that ran, with its version and linear solver."""

    device: str
    """Platform and device kind, e.g. `cpu: cpu`."""

    dtype: str
    """Floating point type, e.g. float64."""

    threads: int
    """Number of threads available to the run."""

    repeat: int
    """Number of the repeat, from 0."""

    setup_s: float
    """Seconds to build the layout or the problem of another library."""

    compile_s: float
    """Seconds of compilation; not part of the other times, except perhaps of `total_s`."""

    total_s: float
    """Seconds from the problem in memory to the solution."""

    initial_cost: float
    """Cost at the start, pixels squared."""

    final_cost: float
    """Last accepted cost, pixels squared."""

    iterations: int
    """Linear solves, accepted or rejected."""

    accepted: int
    """Number of iterations whose step was accepted."""

    cg_iterations: int
    """Conjugate gradient iterations, summed over the linear solves."""

    termination: str
    """Why the solve stopped; `jaxba.bench.profile.CONVERGED` lists the reasons that count as
    converged."""

    trace: tuple[TracePoint, ...]
    """The start and every iteration."""

    notes: tuple[str, ...] = ()
    """What was measured and does not fit (`Solution.notes`)."""


def record_of(
    solution: Solution,
    steps: Sequence[IterationRecord],
    *,
    name: str,
    family: str,
    solver: SolverName,
    repeat: int = 0,
) -> Record:
    """The record of a solution and its iterations."""
    start = TracePoint(0, 0.0, solution.initial_cost, math.nan, True, 0, math.nan)
    names = [one.name for one in fields(TracePoint)[2:]]
    values = [[np.asarray(getattr(item.step, name)).item() for name in names] for item in steps]
    trace = [
        start,
        *(
            TracePoint(item.iteration, item.time_s, *x)
            for item, x in zip(steps, values, strict=True)
        ),
    ]
    device = jax.devices()[0]
    return Record(
        problem=name,
        family=family,
        cameras=solution.problem.num_cameras,
        points=solution.problem.num_points,
        observations=solution.problem.num_observations,
        solver=str(solver),
        backend=f"jaxba {version('jaxba')} ({solution.linear_solver})",
        device=f"{device.platform}: {device.device_kind}",
        dtype=solver.dtype,
        threads=threads(),
        repeat=repeat,
        setup_s=solution.setup_s,
        compile_s=solution.compile_s,
        total_s=solution.total_s,
        initial_cost=solution.initial_cost,
        final_cost=solution.final_cost,
        iterations=solution.iterations,
        accepted=solution.accepted,
        cg_iterations=int(solution.history.cg_iterations.sum()),
        termination=solution.termination.name.lower(),
        trace=tuple(trace),
        notes=solution.notes,
    )
