"""Which policy should be the default: solves of whole problems, of windows of them, and of random
scenes.

    python -m benchmarks.default_policy [SOLVER ...] [--draw 0] [--groups whole window scene] [--out
    FILE] [--within]

Problems come from `JAXBA_DATA`: each whole file, windows of 4 to 40 neighbouring cameras, as they
are or disturbed by 0.3 and 1 degree, and random scenes of 20 to 2,000 cameras whose path drifts, a
third of them far from the truth. `--draw` is the seed of windows and scenes: a policy is chosen on
one draw and judged on another. `--out` keeps what was solved, so that a run goes on where it was,
and more solvers can join.

The price of a solve is its iterations, and 0.25 for each repair (the median of measured times). A
row has a solver's price over that of the first solver, problem by problem, to 1e-3 and 1e-4 above
the best known cost and to its end, with 95% intervals; how often it never came there; its largest
price over the cheaper one of `guarded` and `bold`; and how far above the best end it ends.

`--within` judges the estimated distance to the end (`distance_to_end`) on the solves of the first
solver: how many stop within the tolerance, and after how many iterations."""

from __future__ import annotations

import argparse
import json
import sys
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np

import jaxba
from benchmarks.suite import real_problems
from jaxba.bench.sources import sources
from jaxba.game.statistics import geometric_mean, paired_ratio
from jaxba.game.windows import covisible
from jaxba.lm.termination import distance_to_end
from jaxba.paper.subproblem import sub_problem
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import camera_centers
from jaxba.runtime import process
from jaxba.scenes import SceneConfig
from jaxba.scenes.config import LIKE
from jaxba.solver.names import parse_solver

SOLVERS = ("guarded", "bold", "nielsen+embedded", "constant:1e-8+embedded", "ceres+refine3")
"""The first is what the others are compared with."""

YARDSTICKS = ("guarded", "bold")
"""Their better one is what no default may be much worse than."""

REPAIR = 0.25
"""Price of a repair in iterations: the median of measured times was 0.23 (0.1 to 0.45)."""

TOLERANCES = (1e-3, 1e-4, None)
"""Relative distances to the best known cost; None: to the solver's own end."""

DEGREES = (0.0, 0.3, 1.0)
"""Disturbances of windows, one after the other."""

OPTIMISED = "-post"
UNDISTURBED = 0.1
"""Problems of this name begin at their end, so that their windows are disturbed by so many degrees
at least."""

WINDOWS = 6
LARGEST_WINDOW = 40
"""Windows of a problem, and cameras of the largest."""

CAMERAS = (20, 60, 170, 400, 1000, 2000)
"""Of random scenes; from `MANY` on there is one of each kind."""

MANY = 1000

FAR = {"start_rotation": 0.02, "start_center": 0.2, "start_point": 0.04, "start_focal": 0.03}
"""Start of a scene far from the truth: ten times the usual distances."""


class Case(NamedTuple):
    """A problem of a group."""

    group: str
    name: str
    problem: BundleProblem


def disturbed(problem: BundleProblem, seed: int, degrees: float) -> BundleProblem:
    """Rotations are off by an angle, centres and points by a fiftieth of the median distance per
    degree."""
    centers = camera_centers(np.asarray(problem.cameras))
    size = float(np.median(np.linalg.norm(centers - np.median(centers, 0), axis=1))) or 1.0
    moved = 0.02 * degrees * size
    return jaxba.perturb(problem, seed, np.radians(degrees) / np.sqrt(3), moved, moved)


def cases(draw: int) -> Iterator[Case]:
    """All problems of a draw, one after the other."""
    for source in sources(real_problems()):
        problem = source.read()
        rng = np.random.default_rng([draw, len(source.name)])
        optimised = OPTIMISED in source.name
        yield Case(
            "whole", source.name, disturbed(problem, draw, DEGREES[1]) if optimised else problem
        )
        linked = covisible(problem)
        np.fill_diagonal(linked, 0)
        for number in range(WINDOWS if problem.num_cameras > 12 else 2):
            size = int(rng.integers(4, min(LARGEST_WINDOW, problem.num_cameras) + 1))
            try:
                window = sub_problem(problem, _neighbours(linked, size, rng))
            except ProblemError:  # no common points
                continue
            degrees = max(DEGREES[number % 3], UNDISTURBED * optimised)
            start = disturbed(window, int(rng.integers(1 << 30)), degrees) if degrees else window
            yield Case(f"window, {degrees:g} degrees", f"{source.name}/{number}", start)
    for number, (name, config) in enumerate(_scenes()):
        yield Case(
            "scene, far" if name.endswith("far") else "scene",
            name,
            jaxba.random_scene(config, 100 * draw + number),
        )


def _neighbours(linked: np.ndarray, size: int, rng: np.random.Generator) -> np.ndarray:
    """Cameras that join one by one, each time the one that shares most points with those already
    there."""
    chosen = [int(rng.integers(len(linked)))]
    while len(chosen) < size:
        rest = np.setdiff1d(np.arange(len(linked)), chosen)
        chosen.append(int(rest[np.argmax(linked[rest][:, chosen].sum(axis=1))]))
    return np.array(chosen)


def _scenes() -> Iterator[tuple[str, SceneConfig]]:
    orbit = SceneConfig(trajectory="orbit", min_depth=4.0, max_depth=16.0)
    kinds = {
        "street": LIKE["ladybug-49"],
        "lateral": SceneConfig(trajectory="lateral"),
        "orbit": orbit,
    }
    for cameras in CAMERAS:
        for kind, config in {**kinds, "photos": LIKE["trafalgar-21"]}.items():
            drift = 0.0 if kind == "photos" else 0.3 * cameras**-1.5
            points = (25 if cameras < MANY else 12) * cameras
            base = replace(
                config, cameras=cameras, points=points, observations=0, start_drift=drift
            )
            base = replace(base, outlier_share=0.002, outlier_size=10.0)
            yield f"{kind}-{cameras}", base
            if cameras < MANY:
                yield f"{kind}-{cameras}-far", replace(base, start_drift=3 * drift, **FAR)


def play(problem: BundleProblem, solver: str) -> dict[str, Any]:
    """The record of a solve."""
    policy, options = parse_solver(solver).build()
    small = problem.num_cameras <= 64 and problem.num_observations <= 60_000
    options = replace(options, compilation="full", pad=True if small else None)
    solution = jaxba.solve(problem, policy, options, callback=lambda record: None)
    history = {name: np.asarray(x).tolist() for name, x in solution.history._asdict().items()}
    ends = {
        "initial": solution.initial_cost,
        "final": solution.final_cost,
        "converged": solution.converged,
    }
    return {**ends, "history": history, "linear_solver": solution.linear_solver}


def price(run: dict[str, Any], target: float) -> float:
    """Price until the cost is at or below a target; infinite if it never is."""
    history = run["history"]
    spent = np.cumsum(1 + REPAIR * np.array(history["repairs"]))
    reached = np.flatnonzero(np.array(history["cost"]) <= target)
    return float(spent[reached[0]]) if len(reached) else np.inf


def rows(runs: dict[str, dict[str, Any]], names: list[str], first: str) -> Iterator[str]:
    """A line for each solver, of runs by problem and solver."""
    best = {problem: min(run["final"] for run in found.values()) for problem, found in runs.items()}
    for name in names:
        cells = []
        for tolerance in TOLERANCES:

            def target(problem, run, tolerance=tolerance):
                return best[problem] * (1 + tolerance) if tolerance else run["final"]

            prices = {
                one: np.array(
                    [price(found[one], target(p, found[one])) for p, found in runs.items()]
                )
                for one in dict.fromkeys([name, first, *(y for y in YARDSTICKS if y in names)])
            }
            mine = prices[name]
            theirs = prices[first]
            both = np.isfinite(mine) & np.isfinite(theirs)
            better = np.min([prices[y] for y in YARDSTICKS if y in prices] or [theirs], axis=0)
            known = np.isfinite(better) & np.isfinite(mine)
            worst = float(np.max(mine[known] / better[known])) if known.any() else np.nan
            ratio, low, high = (
                paired_ratio(mine[both], theirs[both]) if both.any() else (np.nan,) * 3
            )
            cells.append(
                f"{ratio:.2f} [{low:.2f}, {high:.2f}] {int(np.sum(~np.isfinite(mine))):2d} "
                f"{worst:4.1f}"
            )
        above = np.array([found[name]["final"] / best[p] - 1 for p, found in runs.items()])
        ends = f"{np.mean(above > 1e-3):4.0%} {np.mean(above > 1e-2):4.0%} {above.max():7.4f}"
        yield f"{name:24s} | " + " | ".join(cells) + f" | {ends}"


def judge(runs: dict[str, dict[str, Any]], solver: str) -> Iterator[str]:
    """How well `distance_to_end` stops solves: a line for each tolerance."""
    for within in (1e-2, 1e-3, 1e-4):
        covered = []
        taken = []
        whole = []
        for found in runs.values():
            run = found[solver]
            if not run["converged"]:
                continue
            step = jaxba.StepInfo._make(
                np.array(run["history"][name]) for name in jaxba.StepInfo._fields
            )
            stops = np.flatnonzero(distance_to_end(step, np.where) <= within)
            last = int(stops[0]) if len(stops) else len(step.cost) - 1
            covered.append(step.cost[last] <= run["final"] * (1 + within))
            taken.append(last + 1.0)
            whole.append(float(len(step.cost)))
        means = f"{geometric_mean(taken):.2f} iterations for {geometric_mean(whole):.2f}"
        yield f"within {within:g}: {np.mean(covered):.3f} of {len(covered)} solves, {means}"


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("solver", nargs="*", default=SOLVERS)
    parser.add_argument("--draw", type=int, default=0)
    parser.add_argument("--groups", nargs="*", default=("whole", "window", "scene"))
    parser.add_argument("--out", type=Path)
    parser.add_argument("--within", action="store_true")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    names = list(args.solver)
    groups = defaultdict[str, dict[str, Any]](dict)
    lines = args.out.read_text().splitlines() if args.out and args.out.exists() else ()
    known = {(one["draw"], one["name"], one["solver"]): one for one in map(json.loads, lines)}
    for group, name, problem in cases(args.draw):
        if not group.startswith(tuple(args.groups)):
            continue
        for solver in names:
            key = args.draw, name, solver
            if key not in known:
                known[key] = {
                    "draw": args.draw,
                    "name": name,
                    "solver": solver,
                    **play(problem, solver),
                }
                if args.out:
                    with args.out.open("a") as file:
                        file.write(json.dumps(known[key]) + "\n")
            groups[group].setdefault(name, {})[solver] = known[key]
        print(f"{group}: {name}", file=sys.stderr, flush=True)
    together = {name: found for group in groups.values() for name, found in group.items()}
    print(
        "solver | to 1e-3: ratio [interval], failures, largest | to 1e-4 | to the end | above best "
        "by 0.1%, 1%, most"
    )
    for group, runs in {**groups, "all": together}.items():
        print(f"{group} ({len(runs)})", *rows(runs, names, names[0]), sep="\n")
    if args.within:
        print(*judge(together, names[0]), sep="\n")


if __name__ == "__main__":
    main()
