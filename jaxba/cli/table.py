"""Text that `jaxba-solve` prints around the table of iterations (solver/progress.py): a heading and
a summary."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from jaxba.cli.common import counted
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.facing import NAMED, views_behind, without_views_of
from jaxba.problem.labels import part_name, part_names
from jaxba.problem.losses import Loss
from jaxba.problem.options import StepOptions
from jaxba.problem.preprocess import MIN_TRACK, observed
from jaxba.solver.methods import DEFAULT_METHOD
from jaxba.solver.names import split_refinement
from jaxba.solver.solve import Solution

if TYPE_CHECKING:
    from jaxba.results.retriangulate import Retriangulation


def heading(name: str, problem: BundleProblem, args: Any, options: StepOptions) -> str:
    """Size of the problem, and the policy and options of the solve."""
    work = options.refinement
    coordinates = options.coordinates
    start = " from the better of step and rays" if work.starts == "rays" else ""
    parts = {
        f" + {counted(work.points, 'point iteration')}{start}": work.points,
        f", up to {counted(work.camera_rounds, 'camera round')}": work.camera_rounds,
        f", up to {work.trials} trials": work.trials > 1,
        f", up to {counted(work.pattern_moves, 'pattern move')}": work.pattern_moves,
        ", distortion per pixel": coordinates.lens_step == "pixels",
    }
    refine = "".join(text for text, present in parts.items() if present)
    solver = (
        f"linear solver {args.linear_solver}"
        if args.method == DEFAULT_METHOD
        else f"method {args.method}"
    )
    counts = (
        ("camera", problem.num_cameras),
        ("point", problem.num_points),
        ("observation", problem.num_observations),
    )
    sizes = ", ".join(counted(count, noun) for noun, count in counts)
    sizes += "".join(f", {part}" for part in [*_lenses(problem, options), *_constants(problem)])
    return (
        f"{name}: {sizes}\npolicy {split_refinement(args.policy)[0]}{refine}, {args.dtype}, "
        f"{solver}"
    )


def _lenses(problem: BundleProblem, options: StepOptions) -> Iterator[str]:
    """How many lenses there are of each camera model, with the numbers that are optimised."""
    lenses = problem.lenses
    if lenses is None:
        return
    free = np.asarray(lenses.free) & (options.intrinsics == "free")
    kinds = ((lenses.model_of(lens), tuple(row)) for lens, row in enumerate(free.tolist()))
    for (model, moves), number in Counter(kinds).most_common():
        names = (
            ", ".join(name for name, moved in zip(model.parameters, moves, strict=False) if moved)
            or "constant"
        )
        name = "lens" + "es" * (number > 1) if lenses.all_bal else model.name
        yield f"{number} {name} ({names})"


def _constants(problem: BundleProblem) -> list[str]:
    if problem.constants is None:
        return []
    poses = np.asarray(problem.constants.poses)
    whole = int(poses.all(axis=1).sum())
    points = int(np.sum(problem.constants.points))
    part = int(poses.any(axis=1).sum()) - whole
    found = (whole, "constant pose"), (part, "partly constant pose"), (points, "constant point")
    return [counted(count, what) for count, what in found if count]


def retriangulated(found: Retriangulation, ftol: float) -> str:
    """The result of a search for points at other depths, as a line between two rows."""
    count = f"{found.moved} of {found.problem.num_points} points moved"
    costs = f"cost {found.cost_before:.6e} -> {found.cost_after:.6e}"
    if not found.moved:
        return "   search for points at other depths: none found"
    dropped = "" if found.pays(ftol) else ": not worth going on, left as they were"
    return f"   search for points at other depths: {count}, {costs}{dropped}"


def summary(problem: BundleProblem, solution: Solution, loss: Loss | None = None) -> str:
    """The result of a solve in a few lines. `loss` is that of the solve; None: squared
    residuals."""
    state = "converged" if solution.converged else "not converged"
    left_out = rejected(solution)
    notes = solution.notes
    sizes = solution.num_residuals, solution.num_parameters
    if solution.rejected is None:
        problem, end = (
            without_views_of(p, solution.set_aside) for p in (problem, solution.problem)
        )
    else:
        problem, end = (p.subset(~solution.rejected) for p in (problem, solution.problem))
    solution = replace(solution, problem=end)
    costs = [solution.initial_cost, solution.final_cost]
    # else the residuals' own, in the solve's arithmetic
    if problem.residuals or not (loss or Loss()).trivial:
        costs = [geometry.cost(p) for p in (problem, solution.problem)]
    rms = [np.sqrt(2 * cost / problem.num_observations) for cost in costs]
    # a robust loss may bear a residual that overflows
    shown = f" (rms {rms[0]:.4g} -> {rms[1]:.4g} px)" if np.isfinite(rms).all() else ""
    # COLMAP prints the root of the cost over the number of residuals
    colmaps = [
        np.sqrt(cost / (2 * problem.num_observations))
        for cost in (solution.initial_cost, solution.final_cost)
    ]
    as_colmap = (
        f"; COLMAP's measure: {colmaps[0]:.6f} -> {colmaps[1]:.6f} px"
        if problem.labels is not None
        else ""
    )
    kinds = solution.costs.items() if problem.residuals else ()
    by_kind = (
        [f"of it at the end: {', '.join(f'{name} {cost:.6e}' for name, cost in kinds)}"]
        if kinds
        else []
    )
    distance = solution.distance
    left = f"; estimated within {distance:.1e} of the end" if math.isfinite(distance) else ""
    misfits = [f"note: {note}" for note in notes]
    lines = [
        f"{state}: {solution.termination.reason}{left}",
        f"cost {solution.initial_cost:.6e} -> {solution.final_cost:.6e}{shown}{as_colmap}",
        *by_kind,
        f"{counted(solution.iterations, 'iteration')}, {solution.accepted} accepted; "
        f"linear solver {solution.linear_solver}; {sizes[0]} residuals, {sizes[1]} parameters",
        f"time: set-up {solution.setup_s:.2f} s, compilation {solution.compile_s:.2f} s, "
        f"iterations {solution.total_s:.2f} s" + _how_compiled(solution),
    ]
    remarked = [*remarks(problem, solution), *without_weight(solution, loss or Loss())]
    return "\n".join([*lines, *left_out, *misfits, *remarked])


def rejected(solution: Solution) -> list[str]:
    """A note on observations that were rejected, by image, and on images that lost all of them."""
    if solution.rejected is None:
        return []
    problem = solution.problem
    count = len(solution.rejected)
    gone, views = (
        np.bincount(problem.camera_index[mask], minlength=problem.num_cameras)
        for mask in (solution.rejected, slice(None))
    )
    worst = np.argsort(-gone / np.maximum(views, 1), kind="stable")[: np.count_nonzero(gone)]
    named = [
        f"{part_name(problem.labels, 'image', at)} {gone[at]} of {views[at]}"
        for at in worst[:NAMED]
    ]
    more = f" and {counted(len(worst) - NAMED, 'more image')}" if len(worst) > NAMED else ""
    by_image = f": {', '.join(named)}{more}" if named else ""
    lost = part_names(problem.labels, "image", solution.set_aside, NAMED)
    lost = f"; nothing fits {lost}, whose pose stays as it was" if lost else ""
    return [f"note: rejected {gone.sum()} of {counted(count, 'observation')}{by_image}{lost}"]


def without_weight(solution: Solution, loss: Loss) -> list[str]:
    """A note on observations that the loss ignored at the end, with what to do if those are most of
    them."""
    if loss.rho != "tukey":
        return []
    norms = np.linalg.norm(geometry.residuals(solution.problem), axis=1)
    beyond = int(np.sum(norms >= loss.scale))
    if not beyond:
        return []
    line = (
        f"note: {counted(beyond, 'observation')} of {len(norms)} beyond --loss-scale "
        f"{loss.scale:g} px had no weight"
    )
    if 2 * beyond < len(norms):
        return [line]
    return [
        f"{line}: choose a larger one (half of the residuals lie above {np.median(norms):.3g} px), "
        "or another --loss"
    ]


def _how_compiled(solution: Solution) -> str:
    """A note on iterations with quickly compiled programs, which are slower; empty if there were
    none."""
    quick = solution.quick_iterations
    if not quick:
        return ""
    which = f"{quick} of them" if quick < solution.iterations else "all"
    return f" ({which} with quickly compiled programs, see --compilation)"


def lost_in(problem: BundleProblem, model: bool) -> str:
    """What a new COLMAP model, or else a BAL or Bundler file, cannot store of a problem, as text;
    may be empty."""
    lenses = problem.lenses
    lost = {
        "which images share a lens": not model and lenses is not None and lenses.shared,
        "which numbers of a lens are constant": lenses is not None
        and not np.asarray(lenses.free).all(),
        "which poses and points are constant": problem.constants is not None,
        "rigs": problem.rigs is not None,
        "priors and other residuals": bool(problem.residuals),
        "weights of observations": problem.whitening is not None,
    }
    return ", ".join(what for what, is_lost in lost.items() if is_lost)


def remarks(problem: BundleProblem, solution: Solution) -> list[str]:
    """Notes on what has no observations, on points with one, and behind cameras. Other residuals'
    rows count too."""
    points = np.bincount(np.asarray(problem.point_index), minlength=problem.num_points)
    for own in (own for rows in problem.residuals.rows for own in rows.points):
        points += np.bincount(own[own >= 0], minlength=problem.num_points)
    cameras, _ = observed(problem)
    alone = ~cameras
    alone[solution.set_aside] = False
    if problem.constants is not None:  # no surprise that these stay
        alone &= ~np.asarray(problem.constants.poses).all(axis=1)
        points = np.where(problem.constants.points, MIN_TRACK, points)
    if problem.rigs is not None:  # others move with their frame
        frame = np.asarray(problem.rigs.frame)
        alone = alone & ~np.isin(frame, frame[cameras])
    before, after = (views_behind(p) for p in (problem, solution.problem))
    dropped = solution.rejected is not None and bool(solution.rejected.any())
    fate = "left out of the output" if dropped else "positions stay as they are"
    found = [
        (int(np.sum(alone)), "camera", "without observations; poses stay as they are"),
        (int(np.sum(points == 0)), "point", f"without observations; {fate}"),
        (int(np.sum(points == 1)), "point", "seen once; damping alone fixes the depth"),
    ]
    lines = [f"note: {counted(count, noun)} {text}" for count, noun, text in found if count]
    if before.any() or after.any():
        of_image = np.bincount(
            problem.camera_index[after if after.any() else before], minlength=problem.num_cameras
        )
        most = np.argsort(-of_image, kind="stable")[: np.count_nonzero(of_image)]
        why = (
            ": is the scene mirrored, or of another convention?"
            if 2 * np.sum(before) > len(before)
            else ""
        )
        lines.append(
            f"note: observations behind their camera: {np.sum(before)} at the start, "
            f"{np.sum(after)} at the end "
            f"(most of {part_names(problem.labels, 'image', most, NAMED)}){why}"
        )
    return lines
