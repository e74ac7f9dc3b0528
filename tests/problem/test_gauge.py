"""Gauges beside COLMAP: what is held already counts, and a minimum stays where it is.

The truth is COLMAP's own bundle adjustment: its number of unknowns, and its cost at the end.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import constrained

from jaxba import (
    BundleProblem,
    ProblemWarning,
    SolveOptions,
    Tolerances,
    hold,
    read_colmap,
    solve,
    with_gauge,
    with_position_priors,
    write_colmap,
)
from jaxba.problem import geometry
from jaxba.problem.frames import num_unknowns

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")

pytestmark = pytest.mark.extra

TIGHT = SolveOptions(max_iterations=300, tolerances=Tolerances(ftol=1e-13, xtol=1e-13))
CONSTANT = {"refine_sensor_from_rig": False}
NOT_NEEDED = "is not needed"


def model_of(folder: Path, cameras: int = 1, frames: int = 3, points: int = 60) -> Path:
    """A model of one rig with noise in pixels, poses and points."""
    pycolmap.set_random_seed(1)
    options = pycolmap.SyntheticDatasetOptions()
    noise = pycolmap.SyntheticNoiseOptions()
    options.num_rigs = 1
    options.num_cameras_per_rig = cameras
    options.num_frames_per_rig = frames
    options.num_points3D = points
    options.num_points2D_without_point3D = 0
    model = pycolmap.synthesize_dataset(options)
    noise.point2D_stddev = 0.5
    noise.point3D_stddev = 0.02
    noise.rig_from_world_rotation_stddev = 0.3
    noise.rig_from_world_translation_stddev = 0.02
    pycolmap.synthesize_noise(noise, model)
    return written(model, folder)


def written(model: Any, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    model.write(str(folder))
    return folder


def blind_reference(folder: Path) -> Path:
    """The model, whose reference sensor sees nothing."""
    model = pycolmap.Reconstruction(str(folder))
    reference = model.rig(1).ref_sensor_id.id
    for image in [
        model.image(i) for i in model.reg_image_ids() if model.image(i).camera_id == reference
    ]:
        for key in [k for k, one in enumerate(image.points2D) if one.has_point3D()]:
            model.delete_observation(image.image_id, key)
    return written(model, folder)


def on_an_imu(folder: Path) -> Path:
    """The model on a rig whose reference sensor is an IMU, where the first camera is."""
    model = pycolmap.Reconstruction(str(folder))
    model.write_text(str(folder))
    for old in folder.glob("*.bin"):
        old.unlink()
    lines = (folder / "rigs.txt").read_text().splitlines()
    at = next(n for n, line in enumerate(lines) if not line.startswith("#"))
    identity, count, kind, reference, *others = lines[at].split()
    pose = "1 1 0 0 0 0 0 0"
    lines[at] = f"{identity} {int(count) + 1} IMU 90 {kind} {reference} {pose} {' '.join(others)}"
    (folder / "rigs.txt").write_text("\n".join(lines) + "\n")
    return folder


def by_colmap(
    folder: Path,
    gauge: str | None = None,
    frames: Any = (),
    points: Any = (),
    priors: Any = (),
    **options: bool,
) -> tuple[int, float]:
    """COLMAP's number of unknowns, and its cost at the end."""
    model = pycolmap.Reconstruction(str(folder))
    config = pycolmap.BundleAdjustmentConfig()
    settings = pycolmap.BundleAdjustmentOptions(print_summary=False, **options)
    solver = settings.ceres.solver_options
    solver.function_tolerance = 1e-15
    solver.gradient_tolerance = 1e-12
    solver.max_num_iterations = 300
    for image in model.reg_image_ids():
        config.add_image(image)
    for frame in frames:
        config.set_constant_rig_from_world_pose(frame)
    for point in points:
        config.add_constant_point(int(point))
    if gauge is not None:
        kind = pycolmap.BundleAdjustmentGauge
        config.fix_gauge(kind.TWO_CAMS_FROM_WORLD if gauge == "two-cameras" else kind.THREE_POINTS)
    if priors:
        known = []
        for image, position, stddev in priors:
            one = pycolmap.PosePrior(position=position, position_covariance=stddev**2 * np.eye(3))
            one.coordinate_system = pycolmap.PosePriorCoordinateSystem.CARTESIAN
            one.corr_data_id = model.image(image).data_id
            known.append(one)
        more = pycolmap.PosePriorBundleAdjustmentOptions()
        adjuster = pycolmap.create_pose_prior_ceres_bundle_adjuster(
            settings, more, config, known, model
        )
    else:
        adjuster = pycolmap.create_default_ceres_bundle_adjuster(settings, config, model)
    summary = adjuster.solve().ceres_summary
    return summary.num_effective_parameters_reduced, summary.final_cost


def gauged(problem: BundleProblem, gauge: str, note: str | None = None) -> BundleProblem:
    """The problem with a gauge, which comes with this note."""
    if note is None:
        return with_gauge(problem, gauge)
    with pytest.warns(ProblemWarning, match=note):
        return with_gauge(problem, gauge)


def with_frames_held(problem: BundleProblem, folder: Path, frames: list[int]) -> BundleProblem:
    """The problem with constant frames, by their images of the reference sensor, or of others that
    do not move."""
    model = pycolmap.Reconstruction(str(folder))
    moves = np.zeros(problem.num_cameras, bool)
    if problem.rigs is not None and problem.rigs.free is not None:
        moves = np.asarray(problem.rigs.free)
    of_frames = np.array([model.image(int(i)).frame_id in frames for i in problem.labels.images])
    return hold(problem, poses=of_frames & ~moves)


def ends_as(problem: BundleProblem, cost: float) -> None:
    np.testing.assert_allclose(solve(problem, options=TIGHT).final_cost, cost, rtol=1e-9)


@pytest.mark.parametrize("held", [0, 1, 2])
@pytest.mark.parametrize("cameras", [1, 2])
def test_two_cameras_count_frames_that_are_held(tmp_path, cameras, held):
    folder = model_of(tmp_path / "m", cameras)
    problem = with_frames_held(read_colmap(folder), folder, [1, 2][:held])
    count, cost = by_colmap(folder, "two-cameras", frames=[1, 2][:held])
    found = gauged(problem, "two-cameras", NOT_NEEDED if held == 2 else None)
    assert num_unknowns(found) == count
    ends_as(found, cost)


@pytest.mark.parametrize("held", [0, 1])
def test_two_cameras_leave_the_scale_that_constant_sensors_give(tmp_path, held):
    """COLMAP holds one number more than is free, and ends above the minimum."""
    folder = model_of(tmp_path / "m", 2)
    problem = with_frames_held(hold(read_colmap(folder), extrinsics="all"), folder, [1][:held])
    found = gauged(problem, "two-cameras", NOT_NEEDED if held else None)
    assert (
        num_unknowns(found)
        == by_colmap(folder, "two-cameras", frames=[1][:held], **CONSTANT)[0] + 1
    )
    ends_as(found, by_colmap(folder, **CONSTANT)[1])


@pytest.mark.parametrize(("cameras", "held"), [(1, 0), (1, 1), (1, 2), (1, 3), (1, 4), (2, 0)])
def test_three_points_count_points_that_are_held(tmp_path, cameras, held):
    """Costs are compared with the same points held, since the programs choose others."""
    folder = model_of(tmp_path / "m", cameras)
    problem = hold(read_colmap(folder), points=range(10, 10 + held), extrinsics="all")
    options = CONSTANT if cameras > 1 else {}
    ids = problem.labels.points
    count, _ = by_colmap(folder, "three-points", points=ids[10 : 10 + held], **options)
    found = gauged(
        problem,
        "three-points",
        NOT_NEEDED if held > 2 else "more than is free" if cameras > 1 else None,
    )
    assert num_unknowns(found) == count
    ends_as(found, by_colmap(folder, points=ids[found.constants.points], **options)[1])


def test_a_single_frame_has_the_gauge_of_three_points(tmp_path):
    folder = model_of(tmp_path / "m", 2, frames=1)
    problem = read_colmap(folder)
    found = gauged(problem, "two-cameras", "the gauge holds three points")
    assert num_unknowns(found) == by_colmap(folder, "two-cameras")[0]
    ends_as(found, by_colmap(folder, points=problem.labels.points[found.constants.points])[1])


@pytest.mark.parametrize("make", [blind_reference, on_an_imu])
def test_a_rig_without_a_reference_camera_is_rigid(tmp_path, make):
    folder = make(model_of(tmp_path / "m", 3))
    with pytest.warns(ProblemWarning, match="left out"):  # images, or the IMU
        problem = read_colmap(folder)
    count, cost = by_colmap(folder)
    assert num_unknowns(problem) == count
    found = with_gauge(problem, "two-cameras")
    assert num_unknowns(found) == count - 6
    solved = solve(found, options=TIGHT).problem
    write_colmap(solved, tmp_path / "out", like=folder)
    with pytest.warns(ProblemWarning, match="left out"):
        again = read_colmap(tmp_path / "out")
    for problem in (solved, again):
        np.testing.assert_allclose(geometry.cost(problem), cost, rtol=1e-9)


@pytest.mark.parametrize("gauge", [pytest.param("free", marks=pytest.mark.slow), "two-cameras"])
@pytest.mark.parametrize(
    "measured", [1, *(pytest.param(one, marks=pytest.mark.slow) for one in (2, 3, 10))]
)
def test_position_priors_fix_the_gauge_as_far_as_they_can(tmp_path, measured, gauge):
    """COLMAP leaves fewer than three priors out, and fixes the gauge. A similarity meets them: the
    cost is equal."""
    folder = model_of(tmp_path / "m", frames=10)
    problem = read_colmap(folder)
    rng = np.random.default_rng(0)
    model = pycolmap.Reconstruction(str(folder))
    images = problem.labels.images[:measured].tolist()
    positions = [model.image(i).projection_center() + 0.02 * rng.normal(size=3) for i in images]
    count, cost = by_colmap(
        folder, priors=list(zip(images, positions, measured * [0.05], strict=True))
    )

    def add():
        return with_position_priors(
            problem, np.array(positions), stddev=0.05, images=range(measured)
        )

    if measured < 3:
        with pytest.warns(ProblemWarning, match="the alignment"):
            known = add()
        found = with_gauge(known, gauge)
        assert num_unknowns(found) == count + 7 - (0 if gauge == "free" else {1: 4, 2: 1}[measured])
    else:
        found = gauged(add(), gauge, NOT_NEEDED if gauge != "free" else None)
        assert num_unknowns(found) == count
    ends_as(found, cost)


@pytest.mark.parametrize(
    ("held", "option"),
    [
        ({"poses": "frames"}, "refine_rig_from_world"),
        ({"rotations": "frames"}, "constant_rig_from_world_rotation"),
    ],
)
def test_frames_that_are_held_let_sensors_move(tmp_path, held, option):
    folder = model_of(tmp_path / "m", 2)
    problem = hold(read_colmap(folder), **held)
    (tmp_path / "c.yaml").write_text(
        "".join(f"constant_{part}: {which}\n" for part, which in held.items())
    )
    named = constrained(read_colmap(folder), (), None, str(tmp_path / "c.yaml"))
    np.testing.assert_array_equal(named.constants.poses, problem.constants.poses)
    count, cost = by_colmap(folder, **{option: "poses" not in held})
    assert num_unknowns(problem) == count
    ends_as(problem, cost)


def test_sensors_come_back_bit_for_bit_where_all_poses_are_held(tmp_path):
    problem = hold(read_colmap(model_of(tmp_path / "m", 3)), poses="all")
    solution = solve(problem)
    np.testing.assert_array_equal(solution.problem.rigs.rotation, problem.rigs.rotation)
    np.testing.assert_array_equal(solution.problem.rigs.translation, problem.rigs.translation)
    np.testing.assert_array_equal(solution.problem.cameras[:, :6], problem.cameras[:, :6])
    assert solution.final_cost < solution.initial_cost
