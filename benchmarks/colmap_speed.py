"""COLMAP models solved by jaxba and by COLMAP: seconds, memory, final cost.

    python -m benchmarks.colmap_speed [--images 3000] [--points 30000] [--track 5] [--compilation
    auto] python -m benchmarks.colmap_speed --models FOLDER ... --solvers
    explicit,sparse,implicit,colmap

Without models it is a random scene whose images share one OPENCV lens. Needs the extra `ceres`.
Each side is a process of its own; memory is its largest resident set. Both read the same COLMAP
model, have a squared loss and stop at a relative decrease of 1e-6. Seconds of ours are those of
set-up and iterations, by default in fully compiled programs; compilation is apart, and takes most
of the memory. COLMAP uses all cores."""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

FTOL = 1e-6
LENS = [800.0, 805.0, 640.0, 480.0, -0.03, 0.004, 5e-4, -4e-4]


def make(folder: str, images: int, points: int, track: float) -> None:
    """Writes the scene as a COLMAP model."""
    import jaxba
    from jaxba.problem import geometry
    from jaxba.problem.bundle_problem import BundleProblem
    from jaxba.problem.camera_models import CAMERA_MODELS
    from jaxba.problem.intrinsics import Lenses

    config = jaxba.SceneConfig(cameras=images, points=points, mean_track=track)
    start, truth = jaxba.random_scene_with_truth(config, seed=0)
    model = CAMERA_MODELS["OPENCV"]
    lenses = Lenses(
        np.zeros(images, np.int32),
        np.ones((1, len(model)), bool) & ~np.isin(range(8), (2, 3)),
        None,
        (model,),
    )
    rng = np.random.default_rng(0)

    def with_lens(
        problem: BundleProblem, numbers: list[float], observations: np.ndarray
    ) -> BundleProblem:
        cameras = np.hstack([np.asarray(problem.cameras)[:, :6], np.tile(numbers, (images, 1))])
        parts = (problem.points, observations, problem.camera_index, problem.point_index)
        return BundleProblem.create(cameras, *parts, lenses=lenses)

    true = with_lens(truth, LENS, np.zeros((truth.num_observations, 2)))
    pixels = geometry.project(true)
    pixels += 0.5 * rng.normal(size=pixels.shape)
    jaxba.write_colmap(
        with_lens(start, [780.0, 780.0, 640.0, 480.0, 0.0, 0.0, 0.0, 0.0], pixels), folder
    )


def ours(folder: str, policy: str, solver: Any, compilation: Any) -> dict[str, float | str]:
    """Solves with jaxba."""
    import jaxba

    problem = jaxba.read_colmap(folder)
    tolerances = jaxba.Tolerances(ftol=FTOL)
    options = jaxba.SolveOptions(
        tolerances=tolerances, linear_solver=solver, compilation=compilation, pad=False
    )
    found = jaxba.solve(problem, policy, options)
    return {
        "initial": found.initial_cost,
        "final": found.final_cost,
        "iterations": found.iterations,
        "seconds": found.total_s + found.setup_s,
        "compilation": found.compile_s,
        "solver": found.linear_solver,
    }


def colmaps(folder: str) -> dict[str, float | str]:
    """Solves with COLMAP's Ceres."""
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    options = pycolmap.BundleAdjustmentOptions(print_summary=False)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    options.ceres.solver_options.function_tolerance = FTOL
    config = pycolmap.BundleAdjustmentConfig()
    for identity in model.reg_image_ids():
        config.add_image(identity)
    started = time.perf_counter()
    summary = pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    seconds = time.perf_counter() - started
    ceres: Any = getattr(summary, "ceres_summary", summary)
    return {
        "initial": ceres.initial_cost,
        "final": ceres.final_cost,
        "iterations": ceres.num_successful_steps + ceres.num_unsuccessful_steps - 1,
        "seconds": seconds,
        "solver": str(ceres.linear_solver_type_used).rpartition(".")[2],
    }


def main() -> None:
    """Prints a line for each side."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--models", nargs="*", default=())
    parser.add_argument("--images", type=int, default=3000)
    parser.add_argument("--points", type=int, default=30_000)
    parser.add_argument("--track", type=float, default=5.0)
    parser.add_argument("--policy", default="guarded")
    parser.add_argument("--solvers", default="auto,colmap")
    parser.add_argument("--compilation", default="full")
    parser.add_argument("--side", nargs=2, metavar=("SIDE", "FOLDER"), help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.side:
        side, folder = args.side
        found = (
            colmaps(folder)
            if side == "colmap"
            else ours(folder, args.policy, side, args.compilation)
        )
        found["memory_gb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
        print(json.dumps(found))
        return
    with tempfile.TemporaryDirectory() as made:
        if not args.models:
            make(made, args.images, args.points, args.track)
        for folder in args.models or (made,):
            for side in args.solvers.split(","):
                command = [sys.executable, "-m", "benchmarks.colmap_speed", "--side", side, folder]
                command += ["--policy", args.policy, "--compilation", args.compilation]
                done = subprocess.run(command, capture_output=True, text=True)
                name = Path(folder).name if args.models else "random scene"
                print(
                    name,
                    side,
                    done.stdout.strip() or done.stderr.strip().splitlines()[-1:],
                    flush=True,
                )


if __name__ == "__main__":
    main()
