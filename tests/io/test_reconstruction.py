"""pycolmap's objects: one line changed in a script gives the same reconstruction.

The truth is pycolmap's own bundle adjustment of the same synthetic data.
"""

from __future__ import annotations

import copy

import numpy as np
import pytest

import jaxba

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")

pytestmark = [pytest.mark.extra, pytest.mark.filterwarnings("ignore::jaxba.ProblemWarning")]


def scene(rigs=10, cameras=1, frames=1):
    pycolmap.set_random_seed(3)
    options = pycolmap.SyntheticDatasetOptions()
    noise = pycolmap.SyntheticNoiseOptions()
    options.num_rigs = rigs
    options.num_cameras_per_rig = cameras
    options.num_frames_per_rig = frames
    options.num_points3D = 100
    found = pycolmap.synthesize_dataset(options)
    noise.point2D_stddev = 0.5
    noise.point3D_stddev = 0.02
    noise.rig_from_world_rotation_stddev = 0.3
    noise.rig_from_world_translation_stddev = 0.02
    pycolmap.synthesize_noise(noise, found)
    return found


def tight(**changes):
    options = pycolmap.BundleAdjustmentOptions()
    ceres = options.ceres.solver_options
    ceres.function_tolerance = 1e-14
    ceres.gradient_tolerance = 1e-12
    ceres.parameter_tolerance = 1e-14
    ceres.max_num_iterations = 300
    options.print_summary = False
    for name, value in changes.items():
        setattr(options, name, value)
    return options


def cost(model):
    """Over all observations of a model, by pycolmap's own projection."""
    total = 0.0
    for point in model.points3D.values():
        for element in point.track.elements:
            image = model.images[element.image_id]
            difference = image.project_point(point.xyz) - image.points2D[element.point2D_idx].xy
            total += 0.5 * float(difference @ difference)
    return total


@pytest.mark.parametrize("shape", [(10, 1, 1), (2, 3, 3)], ids=["images", "rigs"])
def test_a_script_changed_in_one_line_ends_alike(shape):
    theirs = scene(*shape)
    ours = copy.deepcopy(theirs)
    pycolmap.bundle_adjustment(theirs, tight())
    solution = jaxba.bundle_adjustment(ours, tight())
    assert solution.final_cost == pytest.approx(cost(theirs), rel=1e-9)
    assert cost(ours) == pytest.approx(cost(theirs), rel=1e-9)
    ours.update_point_3d_errors()
    assert ours.compute_mean_reprojection_error() == pytest.approx(
        theirs.compute_mean_reprojection_error(), rel=1e-6
    )


@pytest.mark.parametrize("refined", ["refine_focal_length", "refine_extra_params"])
def test_what_options_hold_stays(refined):
    theirs = scene()
    ours = copy.deepcopy(theirs)
    options = tight(**{refined: False})
    pycolmap.bundle_adjustment(theirs, options)
    jaxba.bundle_adjustment(ours, options)
    assert cost(ours) == pytest.approx(cost(theirs), rel=1e-8)


@pytest.mark.parametrize(
    "kind", ["images", "variable points", "constants", "robust", "short tracks"]
)
def test_local_bundle_adjustment_ends_as_colmaps_does(kind):
    theirs = scene()
    ours = copy.deepcopy(theirs)
    options = tight()
    config = pycolmap.BundleAdjustmentConfig()
    images = sorted(theirs.images)[:6]
    points = sorted(theirs.points3D)
    for image in images:
        config.add_image(image)
    if kind != "images":
        for point in points[:20]:
            config.add_variable_point(point)
    if kind == "constants":
        for point in points[20:30]:
            config.add_constant_point(point)
        config.set_constant_rig_from_world_pose(theirs.images[images[0]].frame_id)
        config.set_constant_cam_intrinsics(theirs.images[images[1]].camera_id)
    if kind == "robust":
        options.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
        options.ceres.loss_function_scale = 2.0
    if kind == "short tracks":
        options.min_track_length = 10
        theirs.delete_observation(images[0], 0)
        ours.delete_observation(images[0], 0)
    pycolmap.create_default_bundle_adjuster(options, config, theirs).solve()
    solution = jaxba.bundle_adjustment(ours, options, config)
    assert solution.converged
    assert cost(ours) == pytest.approx(cost(theirs), rel=1e-8)
    for image in theirs.images.values():
        ours_at = ours.images[image.image_id].cam_from_world()
        theirs_at = image.cam_from_world()
        np.testing.assert_allclose(ours_at.matrix(), theirs_at.matrix(), atol=1e-5)


def test_a_part_can_be_written_into_the_whole_model(tmp_path):
    model = scene()
    (tmp_path / "old").mkdir()
    model.write_binary(tmp_path / "old")
    whole = jaxba.read_colmap(tmp_path / "old")
    part = jaxba.part(whole, images=whole.labels.names[:4])
    solution = jaxba.solve(part)
    jaxba.write_colmap(solution.problem, tmp_path / "new", like=tmp_path / "old")
    written = pycolmap.Reconstruction(tmp_path / "new")
    assert cost(written) < cost(model)
    before = pycolmap.Reconstruction(tmp_path / "old")
    for image in sorted(before.images)[4:]:
        assert (
            written.images[image].cam_from_world().matrix()
            == before.images[image].cam_from_world().matrix()
        ).all()


def test_what_cannot_be_is_one_line_without_a_temporary_name():
    model = scene(3)
    config = pycolmap.BundleAdjustmentConfig()
    with pytest.raises(ValueError, match=r"must be a pycolmap\.Reconstruction, not 'sparse/0'"):
        jaxba.from_pycolmap("sparse/0")
    with pytest.raises(jaxba.ProblemError, match=r"^the reconstruction: no image sees a point$"):
        jaxba.from_pycolmap(pycolmap.Reconstruction())
    with pytest.raises(
        jaxba.ProblemError,
        match=r"^the reconstruction: no observation is left of what the config means$",
    ):
        jaxba.from_pycolmap(model, config)
    config.add_image(77)
    with pytest.raises(
        ValueError, match="config names image 77, which the reconstruction does not have"
    ):
        jaxba.from_pycolmap(model, config)
    solution = jaxba.solve(jaxba.from_pycolmap(model), options=jaxba.SolveOptions(max_iterations=1))
    with pytest.raises(jaxba.ProblemError, match="the problem is not one of this reconstruction"):
        solution.update(scene(4))
