"""COLMAP's own bundle adjustment tests, made again: `jaxba.bundle_adjustment` beside pycolmap's
adjuster.

    python -m benchmarks.colmap_tests [--markdown]

Each situation is a synthetic scene with noise, options and a configuration of pycolmap, given to
both as they are. A row has the numbers of unknowns, the cost of jaxba over that of COLMAP less one
with tight tolerances, and with default ones, and iterations with default ones. Costs are computed
by pycolmap, over the observations that count, from what each wrote back. Source: COLMAP 4.2,
`src/colmap/estimators/bundle_adjustment_test.cc`."""

from __future__ import annotations

import argparse
import copy
import warnings
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import pycolmap

import jaxba

Gauge = pycolmap.BundleAdjustmentGauge


class Situation(NamedTuple):
    """What both are given."""

    name: str
    scene: Any  # a Reconstruction
    config: Any
    options: dict[str, Any]
    why: str = ""  # why the ends may differ


def scene(
    rigs: int = 10,
    cameras: int = 1,
    frames: int = 1,
    points: int = 100,
    model: str = "SIMPLE_RADIAL",
) -> Any:
    """A scene with noise."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    noise = pycolmap.SyntheticNoiseOptions()
    options.num_rigs = rigs
    options.num_cameras_per_rig = cameras
    options.num_frames_per_rig = frames
    options.num_points3D = points
    options.num_points2D_without_point3D = 3
    options.camera_model_id = getattr(pycolmap.CameraModelId, model)
    if model == "EQUIRECTANGULAR":
        options.camera_width = 1000
        options.camera_height = 500
        options.camera_params = [1000, 500]
    found = pycolmap.synthesize_dataset(options)
    noise.point2D_stddev = 0.5
    noise.point3D_stddev = 0.02
    noise.rig_from_world_rotation_stddev = 0.3
    noise.rig_from_world_translation_stddev = 0.02
    pycolmap.synthesize_noise(noise, found)
    return found


def configured(of: Any, gauge: Any = None, images: list[int] | None = None, **more: Any) -> Any:
    """A configuration of all images, or of some, that holds more: frames, lenses, sensors, points
    and variable ones."""
    config = pycolmap.BundleAdjustmentConfig()
    for image in sorted(of.images) if images is None else images:
        config.add_image(image)
    adds: dict[str, Callable[[Any], None]] = {
        "frames": config.set_constant_rig_from_world_pose,
        "lenses": config.set_constant_cam_intrinsics,
        "sensors": config.set_constant_sensor_from_rig_pose,
        "points": config.add_constant_point,
        "variable": config.add_variable_point,
    }
    for name, items in more.items():
        for item in items:
            adds[name](item)
    if gauge is not None:
        config.fix_gauge(gauge)
    return config


def situations() -> Iterator[Situation]:
    """COLMAP's tests, by their names."""
    two = Gauge.TWO_CAMS_FROM_WORLD
    three = Gauge.THREE_POINTS

    def made(
        name: str, of: Any, why: str = "", options: dict[str, Any] | None = None, **more: Any
    ) -> Situation:
        return Situation(name, of, configured(of, **more), options or {}, why)

    other = "the two choose other points"
    yield made("Nominal", scene(), gauge=two)
    yield made("NominalMultiCameraRig", scene(2, 3, 3), gauge=two)
    flat = "a flat valley: neither converges"
    yield made("TwoView", scene(2), flat, gauge=two)
    yield made("ThreeViewSpherical", scene(3, model="EQUIRECTANGULAR"), gauge=two)
    rig = scene(1, 2, 2)
    many = scene(1, 3, 3)
    yield made("TwoViewRig", rig, other, gauge=three)
    yield made("ManyViewRig", many, other, gauge=three)
    sensors = list(next(iter(many.rigs.values())).non_ref_sensors)
    less = "COLMAP holds one number more than is free"
    yield made("ManyViewRigConstantSensorFromRig", many, less, gauge=two, sensors=sensors)
    yield made(
        "ManyViewRigConstantSensorFromRig, points", many, other, gauge=three, sensors=sensors
    )
    yield made("ManyViewRigConstantRigFromWorld", many, other, gauge=three, frames=[1])
    yield made(
        "ConstantRigFromWorldRotation",
        scene(2),
        "",
        {"constant_rig_from_world_rotation": True},
        gauge=two,
    )
    yield made("TwoViewConstantCamera", scene(2), flat, gauge=two, lenses=[1])
    yield made("VariableImage", scene(3), gauge=two)
    yield made("ConstantFocalLength", scene(3), "", {"refine_focal_length": False}, gauge=two)
    yield made(
        "VariablePrincipalPoint", scene(2), flat, {"refine_principal_point": True}, gauge=two
    )
    yield made("ConstantExtraParam", scene(2), flat, {"refine_extra_params": False}, gauge=two)
    ten = scene()
    yield made(
        "ConstantPoints3D",
        ten,
        "COLMAP fixes a gauge that points fix",
        {"refine_points3D": False},
        gauge=two,
    )
    for held in (0, 1, 3, 4):
        yield made(
            f"FixGaugeWithThreePoints, {held} held",
            ten,
            other,
            gauge=three,
            points=sorted(ten.points3D)[:held],
        )
    yield made("FixGaugeWithTwoCams, a frame held", ten, gauge=two, frames=[1])
    yield made(
        "FixGaugeWithTwoCams, sensors held, a frame held",
        many,
        less,
        gauge=two,
        sensors=sensors,
        frames=[1],
    )
    yield made("one frame: falls back to three points", scene(1, 3, 1), other, gauge=two)
    yield made("PartiallyContainedTracks", ten, images=sorted(ten.images)[:2], frames=[1])
    forced = sorted(ten.points3D)[:1]
    yield made(
        "PartiallyContainedTracksForceToOptimizePoint",
        ten,
        images=sorted(ten.images)[:2],
        variable=forced,
    )
    yield made("MinimumTrackLength", shortened(ten), "", {"min_track_length": 10}, gauge=two)


def shortened(of: Any) -> Any:
    """A scene with some shorter tracks."""
    found = copy.deepcopy(of)
    for image in sorted(found.images)[:3]:
        for at in range(0, len(found.images[image].points2D), 5):
            if found.images[image].points2D[at].has_point3D():
                found.delete_observation(image, at)
    return found


def solved(one: Situation, *, tight: bool) -> tuple[int, float, int, int, float, int]:
    """Unknowns, cost and iterations of COLMAP, and of jaxba."""
    options = pycolmap.BundleAdjustmentOptions()
    options.print_summary = False
    ceres = options.ceres.solver_options
    if tight:
        ceres.function_tolerance = 1e-15
        ceres.gradient_tolerance = 1e-12
        ceres.parameter_tolerance = 1e-15
        ceres.max_num_iterations = 300
    for name, value in one.options.items():
        setattr(options, name, value)
    model = copy.deepcopy(one.scene)  # the adjuster does not keep it alive
    adjuster: Any = pycolmap.create_default_ceres_bundle_adjuster(options, one.config, model)
    summary = adjuster.solve().ceres_summary
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", jaxba.ProblemWarning)
        ours = jaxba.bundle_adjustment(copy.deepcopy(one.scene), options, one.config)
        unknowns = ours.num_parameters
    count = summary.num_successful_steps + summary.num_unsuccessful_steps
    return (
        summary.num_effective_parameters_reduced,
        summary.final_cost,
        count,
        unknowns,
        ours.final_cost,
        ours.iterations,
    )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--markdown", action="store_true")
    markdown = parser.parse_args().markdown
    heading = (
        "situation",
        "unknowns, COLMAP and jaxba",
        "cost less one, tight",
        "default",
        "iterations",
        "remark",
    )

    def line(cells):
        return (
            f"| {' | '.join(cells)} |" if markdown else "  ".join(f"{cell:>14}" for cell in cells)
        )

    print(line(heading))
    if markdown:
        print(line(["---"] * len(heading)))
    for one in situations():
        try:
            free, cost, _, unknowns, own, _ = solved(one, tight=True)
            _, usual, count, _, own_usual, iterations = solved(one, tight=False)
        except Exception as error:
            print(line([one.name, f"{type(error).__name__}: {error}"[:100], "", "", "", ""]))
            continue
        excess = own / cost - 1, own_usual / usual - 1
        equal = free == unknowns and abs(excess[0]) < 1e-9
        remark = "" if equal else one.why or "differs"
        cells = (
            one.name,
            f"{free} {unknowns}",
            f"{excess[0]:.1e}",
            f"{excess[1]:.1e}",
            f"{count} {iterations}",
            remark,
        )
        print(line(cells), flush=True)


if __name__ == "__main__":
    main()
