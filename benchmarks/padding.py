"""Solves of sliding windows over a sequence, without and with padding of their sizes.

    python -m benchmarks.padding [PROBLEM] [--windows 20] [--cameras 20] [--policy bold] [--repeats
    5]

PROBLEM is a file; by default the windows are parts of a random sequence. All windows are solved
once without and once with padding, each time starting without compiled programs. The time of an
iteration is then measured without compilation on five of the windows."""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from typing import NamedTuple

import jax
import numpy as np

import jaxba
from jaxba.paper.subproblem import sub_problem
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime import process
from jaxba.scenes import SceneConfig

PROGRAM = "/jax/core/compile/backend_compile_duration"
"""JAX's monitoring event for the compilation of a program."""


class FirstSolves(NamedTuple):
    """Measurements of solving all windows once."""

    programs: int  # number of compiled programs
    wall_s: float
    costs: np.ndarray  # final costs, pixels squared
    cells: int  # number of different padded sizes; 1 without padding


def windows(problem: BundleProblem, count: int, cameras: int) -> list[BundleProblem]:
    """Sub-problems of consecutive cameras, evenly spaced, with the points that two of their cameras
    observe."""
    starts = np.linspace(0, problem.num_cameras - cameras, count).astype(int)
    return [sub_problem(problem, np.arange(first, first + cameras)) for first in starts]


def solve_all(
    problems: list[BundleProblem], solve: Callable[[BundleProblem], jaxba.Solution]
) -> FirstSolves:
    """Solves every window once, starting without compiled programs."""
    programs: list[str] = []

    def listen(event, duration_secs, **_):
        return programs.append(event) if event == PROGRAM else None

    jax.clear_caches()
    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        started = time.perf_counter()
        solutions = [solve(problem) for problem in problems]
        wall = time.perf_counter() - started
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    cells = len({solution.capacity for solution in solutions})
    return FirstSolves(
        len(programs), wall, np.array([solution.final_cost for solution in solutions]), cells
    )


def step_seconds(
    problem: BundleProblem, solves: list[Callable[[BundleProblem], jaxba.Solution]], repeats: int
):
    """Least seconds of an iteration and of the set-up for each kind of solve, timed alternately;
    shape (kinds, 2)."""
    jax.clear_caches()
    times = np.full((repeats + 1, len(solves), 2), np.inf)
    for repeat in range(repeats + 1):
        for kind, solve in enumerate(solves):
            solution = solve(problem)
            times[repeat, kind] = solution.total_s / solution.iterations, solution.setup_s
    return times[1:].min(axis=0)


def main() -> None:
    """Prints a table and ratios."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("problem", nargs="?")
    parser.add_argument("--windows", type=int, default=20)
    parser.add_argument("--cameras", type=int, default=20)
    parser.add_argument("--policy", default="bold")
    parser.add_argument("--repeats", type=int, default=5)
    args = parser.parse_args()
    process.keep_memory()
    whole = (
        jaxba.read_problem(args.problem)
        if args.problem
        else jaxba.random_scene(
            SceneConfig(120, 12000, 48000, max_depth=4.0, gap_share=0.0, revisit_share=0.0), 0
        )
    )
    problems = windows(whole, args.windows, args.cameras)
    for name, sizes in (
        ("points", [p.num_points for p in problems]),
        ("observations", [p.num_observations for p in problems]),
    ):
        print(f"{name}: {min(sizes)} to {max(sizes)}")
    plain, pad = (
        lambda problem, pad=pad: jaxba.solve(
            problem,
            args.policy,
            jaxba.SolveOptions(linear_solver="explicit", pad=pad, compilation="full"),
        )
        for pad in (False, True)
    )
    first = [solve_all(problems, solve) for solve in (plain, pad)]
    timed = np.array(
        [
            step_seconds(p, [plain, pad], args.repeats)
            for p in problems[:: max(1, args.windows // 5)]
        ]
    )
    print(f"{'sizes':>8} {'programs':>9} {'wall s':>8} {'ms/iteration':>13} {'set-up ms':>10}")
    for kind, name in enumerate(("as given", "padded")):
        step, setup = 1e3 * np.median(timed[:, kind], axis=0)
        print(
            f"{name:>8} {first[kind].programs:9d} {first[kind].wall_s:8.1f} {step:13.2f} "
            f"{setup:10.1f}"
        )
    print(f"different padded sizes: {first[1].cells}")
    print(f"wall time, padded over as given: {first[1].wall_s / first[0].wall_s:.2f}")
    ratios = timed[:, 1, 0] / timed[:, 0, 0]
    print(
        f"iteration, padded over as given: median {np.median(ratios):.2f}, {ratios.min():.2f} to "
        f"{ratios.max():.2f}"
    )
    print(
        f"final costs differ by at most {np.max(np.abs(first[1].costs / first[0].costs - 1)):.1e}"
    )


if __name__ == "__main__":
    main()
