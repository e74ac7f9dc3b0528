"""Costs beside COLMAP's own on reconstructions that COLMAP makes up: every camera model, what is
free, who shares.

    python -m benchmarks.colmap_models [--models OPENCV,FOV] [--seed 0] [--frames 12] [--points 80]

Needs the extra `ceres`. For every model, free numbers (focal length; and distortion; and principal
point) and sharing (a lens each, one for all, two) the initial and the final cost over COLMAP's,
less one. Then constants, both gauges, position priors, and rigs of three cameras with free and
constant extrinsics. Nothing is written."""

from __future__ import annotations

import argparse
import tempfile
import warnings
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import jaxba
from jaxba.problem import geometry
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.problem.measured import with_position_priors

FREE = {
    "f": {"refine_extra_params": False},
    "f, distortion": {},
    "f, distortion, centre": {"refine_principal_point": True},
}
SIZE = 640, 480
TIGHT = jaxba.SolveOptions(
    tolerances=jaxba.Tolerances(ftol=1e-13, xtol=1e-13),
    max_iterations=300,
    linear_solver="explicit",
)
PRIOR_SIGMA = 0.05
START = {
    "omega": 0.5,
    "alpha": 0.5,
    "beta": 1.0,
    "f": 500.0,
    "fx": 500.0,
    "fy": 500.0,
    "cx": 320.0,
    "cy": 240.0,
}


def reconstruction(
    kind: str, cameras: int, frames: int, points: int, seed: int, in_rig: int = 1
) -> Any:
    """A reconstruction that COLMAP makes up, with noise of half a pixel and a start that is a
    little off."""
    import pycolmap

    pycolmap.set_random_seed(seed)
    rng = np.random.default_rng(seed)
    params = [
        START[name] if name in START else rng.uniform(-0.01, 0.01)
        for name in CAMERA_MODELS[kind].parameters
    ]
    options = pycolmap.SyntheticDatasetOptions()
    options.num_rigs = cameras
    options.num_cameras_per_rig = in_rig
    options.num_frames_per_rig = frames // cameras
    options.num_points3D = points
    options.num_points2D_without_point3D = 0
    options.camera_width, options.camera_height = SIZE
    options.camera_model_id = getattr(pycolmap.CameraModelId, kind)
    options.camera_params = params
    made = pycolmap.synthesize_dataset(options)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = 0.5
    noise.point3D_stddev = 0.02
    noise.rig_from_world_translation_stddev = 0.02
    noise.rig_from_world_rotation_stddev = 0.3
    pycolmap.synthesize_noise(noise, made)
    return made


def cost_of(model: Any) -> float:
    """Half the squared errors of all observations, projected by COLMAP."""
    total = 0.0
    for identity in model.reg_image_ids():
        image = model.image(identity)
        for key in image.points2D:
            if key.has_point3D():
                error = np.array(image.project_point(model.point3D(key.point3D_id).xyz)) - key.xy
                total += 0.5 * float(error @ error)
    return total


def settings(**free: bool) -> tuple[Any, Any]:
    """COLMAP's options for a squared loss and tight tolerances."""
    import pycolmap

    options = pycolmap.BundleAdjustmentOptions(print_summary=False, **free)
    options.ceres.loss_function_type = pycolmap.LossFunctionType.TRIVIAL
    solver = options.ceres.solver_options
    solver.max_num_iterations = 300
    solver.function_tolerance = 1e-14
    solver.gradient_tolerance = 1e-12
    solver.parameter_tolerance = 1e-14
    return options, pycolmap.BundleAdjustmentConfig()


def by_colmap(
    folder: str, change: Callable[[Any, Any], None] = lambda config, model: None, **free: bool
) -> Any:
    """The model after COLMAP's own bundle adjustment; `change` may change its configuration."""
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    options, config = settings(**free)
    for identity in model.reg_image_ids():
        config.add_image(identity)
    change(config, model)
    pycolmap.create_default_ceres_bundle_adjuster(options, config, model).solve()
    return model


def rows(kind: str, args: argparse.Namespace) -> Iterator[tuple[str, str, float, float]]:
    """Sharing, what is free, and both costs over COLMAP's, less one."""
    for sharing, cameras in (("one each", args.frames), ("one", 1), ("two", 2)):
        with tempfile.TemporaryDirectory() as folder:
            made = reconstruction(kind, cameras, args.frames, args.points, args.seed)
            made.write(folder)
            for free, options in FREE.items():
                if (
                    options.get("refine_extra_params") is False
                    and not CAMERA_MODELS[kind].distortion
                ):
                    continue
                centre = options.get("refine_principal_point", False)
                problem = jaxba.read_colmap(folder, refine_principal_point=centre)
                if not options.get("refine_extra_params", True):
                    problem = jaxba.hold(problem, numbers=["distortion"])
                solution = jaxba.solve(problem, args.policy, TIGHT)
                start = cost_of(made)
                end = cost_of(by_colmap(folder, **options))
                yield (
                    sharing,
                    free,
                    geometry.cost(problem) / start - 1,
                    solution.final_cost / end - 1,
                )


def constraints(args: argparse.Namespace) -> Iterator[tuple[str, float, float]]:
    """Constants, gauges and priors."""
    import pycolmap

    with tempfile.TemporaryDirectory() as folder:
        reconstruction("OPENCV", 2, args.frames, args.points, args.seed).write(folder)
        problem = jaxba.read_colmap(folder)
        assert problem.labels is not None
        ids = problem.labels.images.tolist()
        points = problem.labels.points.tolist()
        lenses = problem.labels.lenses.tolist()

        def poses(config: Any, model: Any) -> None:
            for identity in ids[:2]:
                config.set_constant_rig_from_world_pose(model.image(identity).frame_id)

        def some_points(config: Any, model: Any) -> None:
            for identity in points[:5]:
                config.add_constant_point(identity)

        def gauge(config: Any, model: Any) -> None:
            config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)

        def lens(config, model):
            return config.set_constant_cam_intrinsics(lenses[0])

        cases = {
            "two constant poses": (jaxba.hold(problem, poses=[0, 1]), poses),
            "five constant points": (jaxba.hold(problem, points=range(5)), some_points),
            "a constant lens": (jaxba.hold(problem, lenses=[0]), lens),
            "gauge of two cameras": (jaxba.with_gauge(problem, "two-cameras"), gauge),
        }
        for name, (changed, change) in cases.items():
            end = cost_of(by_colmap(folder, change))
            yield name, 0.0, jaxba.solve(changed, args.policy, TIGHT).final_cost / end - 1
        yield "position priors", 0.0, _with_priors(folder, problem, args)


def rigs(args: argparse.Namespace) -> Iterator[tuple[str, float, float]]:
    """Two rigs of three cameras each, OPENCV."""
    with tempfile.TemporaryDirectory() as folder:
        made = reconstruction("OPENCV", 2, args.frames, args.points, args.seed, in_rig=3)
        made.write(folder)
        problem = jaxba.read_colmap(folder)
        start = geometry.cost(problem) / cost_of(made) - 1
        for name, extrinsics in (("free extrinsics", ()), ("constant extrinsics", "all")):
            solution = jaxba.solve(jaxba.hold(problem, extrinsics=extrinsics), args.policy, TIGHT)
            end = cost_of(by_colmap(folder, refine_sensor_from_rig=not extrinsics))
            yield name, start, solution.final_cost / end - 1


def _with_priors(folder: str, problem: jaxba.BundleProblem, args: argparse.Namespace) -> float:
    import pycolmap

    model = pycolmap.Reconstruction(folder)
    rng = np.random.default_rng(args.seed)
    assert problem.labels is not None
    ids = problem.labels.images.tolist()
    places = np.array(
        [model.image(i).projection_center() + PRIOR_SIGMA * rng.normal(size=3) for i in ids]
    )
    spread = PRIOR_SIGMA**2 * np.eye(3)
    frame = pycolmap.PosePriorCoordinateSystem.CARTESIAN
    priors = [
        pycolmap.PosePrior(
            pose_prior_id=i,
            corr_data_id=model.image(i).data_id,
            position=place,
            position_covariance=spread,
            coordinate_system=frame,
        )
        for i, place in zip(ids, places, strict=True)
    ]
    options, config = settings()
    for identity in ids:
        config.add_image(identity)
    adjuster = pycolmap.create_pose_prior_bundle_adjuster(
        options, pycolmap.PosePriorBundleAdjustmentOptions(), config, priors, model
    )
    adjuster.solve()
    away = np.array([model.image(i).projection_center() for i in ids]) - places
    truth = cost_of(model) + 0.5 * float(np.sum(away**2)) / PRIOR_SIGMA**2
    return (
        jaxba.solve(with_position_priors(problem, places, spread), args.policy, TIGHT).final_cost
        / truth
        - 1
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--models", default=",".join(name for name in CAMERA_MODELS if CAMERA_MODELS[name].focal)
    )
    parser.add_argument("--policy", default="ceres")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--frames", type=int, default=12)
    parser.add_argument("--points", type=int, default=80)
    args = parser.parse_args()
    warnings.simplefilter("ignore", jaxba.ProblemWarning)
    print(f"{'model':28s}{'lenses':10s}{'free':24s}{'initial':>10s}{'final':>10s}")
    for kind in args.models.split(","):
        if kind == "BAL":
            continue
        for sharing, free, initial, final in rows(kind, args):
            print(f"{kind:28s}{sharing:10s}{free:24s}{initial:10.1e}{final:10.1e}", flush=True)
    for name, initial, final in constraints(args):
        print(f"{'OPENCV':28s}{'two':10s}{name:24s}{initial:10.1e}{final:10.1e}", flush=True)
    for name, initial, final in rigs(args):
        print(f"{'OPENCV':28s}{'rigs':10s}{name:24s}{initial:10.1e}{final:10.1e}", flush=True)


if __name__ == "__main__":
    main()
