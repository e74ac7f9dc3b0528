"""Statistics of records, for each solver and for each pair of problem and solver.

A mean over the problems on which a target was reached is always given with the number k of these
problems, out of all n problems of the benchmark. Iterations also have a capped mean over all n
problems, in which a target that was not reached counts as `ITERATION_LIMIT`, so that a solver
cannot improve its mean by failing on hard problems."""

from __future__ import annotations

import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from jaxba.bench import profile
from jaxba.bench.profile import Target
from jaxba.game.statistics import SHORTEST_TIME, Reached, capped, geometric_mean
from jaxba.solver.record import Record


class Cell(NamedTuple):
    """One solver on one problem; numbers are medians over repeats."""

    problem: str
    solver: str
    repeats: int
    converged: bool  # more than half of the repeats within `ITERATION_LIMIT` iterations
    termination: str  # distinct reasons of the repeats to stop, joined by a slash
    final_cost: float  # pixels squared; infinite if not finite
    # (final cost + floor) / (f* + floor), floor = `ZERO_RESIDUAL_FLOOR` f0; 1 is the best
    final_ratio: float
    iterations: float
    rejected: float
    seconds: float  # solve time without compilation
    compile_s: float  # of all repeats, of which the first compiles
    reach: dict[str, Reached]  # by `Target.key`


class TargetSummary(NamedTuple):
    """Statistics of a solver on one target over all problems, `total`, also those that it was not
    run on.

    Means are geometric: over the reached problems, with a count of 0 taken as 1, NaN if there are
    none; of `iterations_capped` over all problems, with counts capped at `ITERATION_LIMIT`."""

    reached: int
    total: int
    iterations: float
    iterations_capped: float
    seconds: float


class SolverSummary(NamedTuple):
    """One solver over all problems; the ratio of ends is over those that it was run on."""

    solver: str
    run: int  # number of problems that it was run on
    total: int  # of the benchmark
    targets: dict[str, TargetSummary]  # by `Target.key`
    final_ratio_worst: float
    compile_s: float  # of all runs


class ProblemSummary(NamedTuple):
    """Size of a problem, its initial and best cost (pixels squared), and the first solver that
    reached that."""

    problem: str
    family: str
    cameras: int
    points: int
    observations: int
    initial_cost: float
    best_cost: float
    best_solver: str


@dataclass(frozen=True)
class Summary:
    """The content of all tables."""

    targets: tuple[Target, ...]
    problems: list[ProblemSummary]
    solvers: list[SolverSummary]
    cells: list[Cell]
    warnings: list[str]


def summarize(records: Sequence[Record], tolerance: float = 1e-3) -> Summary:
    """Computes the statistics of all tables, from any number of records, also none. `tolerance` is
    tau of the target `tau`."""
    targets = (*profile.cost_targets(tolerance), Target("converged"))
    starts = profile.initial_costs(records)
    bests = profile.best_cost(records)
    tables = {target.key: profile.reach_table(records, target) for target in targets}
    names = profile.problem_names(records)
    solvers = profile.solver_names(records)
    found = {
        key: {s: profile.reached(table.get(s, {}), names) for s in solvers}
        for key, table in tables.items()
    }
    cells = []
    for name in names:
        for solver in solvers:
            runs = [r for r in records if r.problem == name and r.solver == solver]
            if runs:
                reaches = {key: table[solver][name] for key, table in tables.items()}
                cells.append(_cell(runs, reaches, starts[name], bests[name]))
    counts = {solver: sum(cell.solver == solver for cell in cells) for solver in solvers}
    few = {solver: count for solver, count in counts.items() if count < len(names)}
    warning = "{} was run on {} of {} problems; the others count as not reached"
    return Summary(
        targets=targets,
        problems=[
            _problem(runs, starts[name], bests[name])
            for name, runs in profile.by_problem(records).items()
        ],
        solvers=[_solver(solver, cells, found, len(names)) for solver in solvers],
        cells=cells,
        warnings=profile.cost_warnings(records)
        + [warning.format(*one, len(names)) for one in few.items()],
    )


def _median(values: Iterable[float]) -> float:
    known = [value for value in values if not math.isnan(value)]
    return statistics.median(known) if known else math.nan


def _cell(runs: Sequence[Record], reaches: dict[str, Reached], f0: float, f_star: float) -> Cell:
    final = statistics.median(
        r.final_cost if math.isfinite(r.final_cost) else math.inf for r in runs
    )
    floor = profile.ZERO_RESIDUAL_FLOOR * f0
    return Cell(
        problem=runs[0].problem,
        solver=runs[0].solver,
        repeats=len(runs),
        converged=math.isfinite(reaches["converged"].iterations),
        termination="/".join(dict.fromkeys(r.termination for r in runs)),
        final_cost=final,
        final_ratio=(final + floor) / (f_star + floor)
        if f_star + floor > 0
        else 1.0
        if final <= 0
        else math.inf,
        iterations=_median(float(r.iterations) for r in runs),
        rejected=_median(float(r.iterations - r.accepted) for r in runs),
        seconds=_median(r.trace[-1].time_s if r.trace else r.total_s for r in runs),
        compile_s=sum(r.compile_s for r in runs),
        reach=reaches,
    )


def _problem(runs: Sequence[Record], f0: float, f_star: float) -> ProblemSummary:
    first = runs[0]
    holder = next((r.solver for r in runs if profile.lowest_cost(r) <= f_star), "the start")
    sizes = (first.cameras, first.points, first.observations)
    return ProblemSummary(first.problem, first.family, *sizes, f0, f_star, holder)


def _solver(
    solver: str, cells: Sequence[Cell], found: Mapping[str, Mapping[str, Reached]], total: int
) -> SolverSummary:
    own = [cell for cell in cells if cell.solver == solver]
    return SolverSummary(
        solver=solver,
        run=len(own),
        total=total,
        targets={key: _target(rows[solver]) for key, rows in found.items()},
        final_ratio_worst=max(cell.final_ratio for cell in own),
        compile_s=sum(cell.compile_s for cell in own),
    )


def _target(own: Reached) -> TargetSummary:
    reached = np.isfinite(own.iterations)
    return TargetSummary(
        reached=int(reached.sum()),
        total=len(reached),
        iterations=geometric_mean(own.iterations[reached], floor=1.0),
        iterations_capped=geometric_mean(capped(own.iterations, profile.ITERATION_LIMIT)),
        seconds=geometric_mean(own.seconds[reached], SHORTEST_TIME),
    )
