"""A `pycolmap.Reconstruction` is read, and updated, in memory as it would be by files.

The truth is the reader of files, `part` of the whole, and the writer of files."""

from __future__ import annotations

import copy

import numpy as np
import pytest

import jaxba
from jaxba.io.colmap.memory import read_part
from jaxba.io.reconstruction import update
from jaxba.problem.hold import every_lens, hold

pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")

pytestmark = pytest.mark.extra

ROUNDING = 1e-14  # of quaternions, which pycolmap normalises again when it reads a file


def scene(
    rigs=6, cameras=1, frames=1, points=60, model="SIMPLE_RADIAL", lens=(1280, 512, 384, 0.05)
):
    """A scene with noise, in which some key-points see no point."""
    pycolmap.set_random_seed(2)
    options = pycolmap.SyntheticDatasetOptions()
    noise = pycolmap.SyntheticNoiseOptions()
    options.num_rigs = rigs
    options.num_cameras_per_rig = cameras
    options.num_frames_per_rig = frames
    options.num_points3D = points
    options.num_points2D_without_point3D = 7
    options.camera_model_id = pycolmap.CameraModelId.__members__[model]
    options.camera_params = lens
    reconstruction = pycolmap.synthesize_dataset(options)
    noise.point2D_stddev = 0.5
    noise.point3D_stddev = 0.02
    noise.rig_from_world_rotation_stddev = 0.3
    noise.rig_from_world_translation_stddev = 0.02
    pycolmap.synthesize_noise(noise, reconstruction)
    return reconstruction


def with_short_tracks(reconstruction):
    """The scene without some observations, so that tracks differ."""
    for image in sorted(reconstruction.images):
        for key in range(image % 5, len(reconstruction.images[image].points2D), 3):
            if reconstruction.images[image].points2D[key].has_point3D():
                reconstruction.delete_observation(image, key)
    return reconstruction


def with_two_models(reconstruction):
    """The scene with a camera of another model."""
    camera = reconstruction.camera(2)
    focal, x, y, _ = camera.params
    camera.model = pycolmap.CameraModelId.PINHOLE
    camera.params = [focal, focal, x, y]
    return reconstruction


def without_a_frame(reconstruction):
    """The scene with images that are not registered."""
    reconstruction.deregister_frame(sorted(reconstruction.frames)[1])
    return reconstruction


SCENES = {
    "one lens": lambda: scene(1, 1, 6),
    "lenses": lambda: with_short_tracks(scene()),
    "rigs": lambda: with_short_tracks(scene(2, 3, 3)),
    "OpenCV": lambda: scene(2, 2, 2, model="OPENCV", lens=[1280, 1290, 512, 384, 0.05, 0.01, 0, 0]),
    "two models": lambda: with_two_models(with_short_tracks(scene())),
    "not registered": lambda: without_a_frame(with_short_tracks(scene(2, 2, 3))),
}


@pytest.fixture(params=list(SCENES))
def reconstruction(request):
    return SCENES[request.param]()


def written(reconstruction, folder):
    folder.mkdir()
    reconstruction.write_binary(folder)
    return folder


def from_files(reconstruction, folder):
    return jaxba.read_colmap(written(reconstruction, folder))


def chosen(reconstruction):
    """A config of some images, variable and constant points, and a constant frame and lens."""
    config = pycolmap.BundleAdjustmentConfig()
    images = sorted(reconstruction.reg_image_ids())
    points = sorted(reconstruction.points3D)
    for image in images[: len(images) // 2]:
        config.add_image(image)
    for point in points[:8]:
        config.add_variable_point(point)
    for point in points[8:12]:
        config.add_constant_point(point)
    image = reconstruction.images[images[0]]
    config.set_constant_rig_from_world_pose(image.frame_id)
    config.set_constant_cam_intrinsics(image.camera_id)
    return config


def chosen_of_whole(whole, config, reconstruction):
    """The same part of the problem of all, and the images and points that it sees."""
    labels = whole.labels
    images = labels.positions("image", sorted(config.images))
    points = labels.positions("point", sorted({*config.variable_points, *config.constant_points}))
    problem = jaxba.part(whole, images=images, points=points)
    held = [
        number
        for number in labels.images.tolist()
        if is_held(reconstruction.images[number], config)
    ]
    poses = labels.positions("image", held)
    if problem.rigs is not None and problem.rigs.free is not None:
        poses = poses[~problem.rigs.free[poses]]
    constant = labels.positions("point", sorted(config.constant_points))
    lenses = labels.positions("lens", sorted(config.constant_cam_intrinsics))
    problem = hold(problem, poses=poses, points=constant, lenses=lenses)
    return problem, np.unique(problem.camera_index), np.unique(problem.point_index)


def is_held(image, config):
    return image.frame_id in config.constant_rig_from_world_poses


def assert_same(problem, expected):
    """Bit for bit, but for the numbers of lenses and frames."""
    for name in ("cameras", "points", "observations", "camera_index", "point_index"):
        np.testing.assert_array_equal(getattr(problem, name), getattr(expected, name), err_msg=name)
    assert (problem.constants is None) == (expected.constants is None)
    if expected.constants is not None:
        np.testing.assert_array_equal(problem.constants.poses, expected.constants.poses)
        np.testing.assert_array_equal(problem.constants.points, expected.constants.points)
    ours = every_lens(problem)
    theirs = every_lens(expected)
    np.testing.assert_array_equal(ours.free[ours.index], theirs.free[theirs.index])
    for at in range(problem.num_cameras):
        assert (
            ours.model_of(int(ours.index[at])).name == theirs.model_of(int(theirs.index[at])).name
        )
    assert (problem.rigs is None) == (expected.rigs is None)
    if expected.rigs is not None:
        for name in ("rotation", "translation", "free"):
            np.testing.assert_array_equal(
                getattr(problem.rigs, name), getattr(expected.rigs, name), err_msg=name
            )
        frames = [
            np.unique(rigs.frame, return_inverse=True)[1] for rigs in (problem.rigs, expected.rigs)
        ]
        np.testing.assert_array_equal(*frames)


def test_the_problem_of_all_is_that_of_the_files(reconstruction, tmp_path):
    expected = from_files(reconstruction, tmp_path / "m")
    problem = jaxba.from_pycolmap(reconstruction)
    assert_same(problem, expected)
    for name in ("images", "lenses", "points"):
        np.testing.assert_array_equal(getattr(problem.labels, name), getattr(expected.labels, name))
    assert problem.labels.names == expected.labels.names


def test_the_problem_of_a_config_is_the_part_of_the_files_that_it_means(reconstruction, tmp_path):
    config = chosen(reconstruction)
    whole = from_files(reconstruction, tmp_path / "m")
    expected, images, points = chosen_of_whole(whole, config, reconstruction)
    problem = jaxba.from_pycolmap(reconstruction, config)
    everything = np.ones(expected.num_observations, bool)
    assert_same(problem, expected.subset(everything, images, points))
    assert problem.labels.images.tolist() == whole.labels.images[images].tolist()
    assert problem.labels.points.tolist() == whole.labels.points[points].tolist()
    assert problem.labels.names == whole.labels.of(images, points).names


def test_points_of_short_tracks_do_not_count(tmp_path):
    reconstruction = with_short_tracks(scene())
    options = pycolmap.BundleAdjustmentOptions()
    config = chosen(reconstruction)
    options.min_track_length = least = 4
    lengths = {number: point.track.length() for number, point in reconstruction.points3D.items()}
    assert min(lengths.values()) < least
    for of_config in (None, config):
        problem = jaxba.from_pycolmap(reconstruction, of_config, options)
        assert all(lengths[number] >= least for number in problem.labels.points.tolist())
    whole = from_files(reconstruction, tmp_path / "m")
    expected = jaxba.part(whole, min_track=least)
    assert (
        jaxba.from_pycolmap(reconstruction, None, options).num_observations
        == expected.num_observations
    )


def numbers(reconstruction):
    """What an update may change, each by kind and id."""
    found = {("camera", number): camera.params for number, camera in reconstruction.cameras.items()}
    for number, frame in reconstruction.frames.items():
        if frame.has_pose():
            found["frame", number] = frame.rig_from_world.matrix()
    for number, rig in reconstruction.rigs.items():
        for sensor, place in rig.non_ref_sensors.items():
            found["sensor", number, sensor.id] = place.matrix()
    for number, point in reconstruction.points3D.items():
        found["point", number], found["error", number] = point.xyz, point.error
    return {key: np.array(value) for key, value in found.items()}


def assert_same_numbers(ours, theirs, rounding=ROUNDING):
    assert ours.keys() == theirs.keys()
    for key, value in theirs.items():
        np.testing.assert_allclose(
            ours[key], value, rtol=rounding, atol=10 * rounding, err_msg=str(key)
        )


@pytest.mark.parametrize("kind", ["lenses", "rigs", "two models", "not registered"])
def test_all_is_updated_as_files_are(kind, tmp_path):
    reconstruction = SCENES[kind]()
    problem = jaxba.solve(
        jaxba.from_pycolmap(reconstruction), options=jaxba.SolveOptions(max_iterations=2)
    ).problem
    jaxba.write_colmap(problem, tmp_path / "new", like=written(reconstruction, tmp_path / "old"))
    before = numbers(reconstruction)
    update(reconstruction, problem)
    after = numbers(reconstruction)
    assert_same_numbers(after, numbers(pycolmap.Reconstruction(tmp_path / "new")))
    assert any((after[key] != before[key]).any() for key in after)


@pytest.mark.parametrize("kind", ["lenses", "rigs"])
def test_a_part_is_updated_as_files_are_and_the_rest_stays(kind, tmp_path):
    reconstruction = SCENES[kind]()
    reconstruction.update_point_3d_errors()
    config = chosen(reconstruction)
    options = jaxba.SolveOptions(max_iterations=2)
    expected, *_ = chosen_of_whole(
        from_files(reconstruction, tmp_path / "old"), config, reconstruction
    )
    jaxba.write_colmap(
        jaxba.solve(expected, options=options).problem, tmp_path / "new", like=tmp_path / "old"
    )
    before = numbers(reconstruction)
    solution = jaxba.solve(jaxba.from_pycolmap(reconstruction, config), options=options)
    solution.update(reconstruction)
    after = numbers(reconstruction)
    of_files = numbers(pycolmap.Reconstruction(tmp_path / "new"))
    views = np.bincount(solution.problem.point_index).tolist()
    points = solution.problem.labels.points.tolist()
    seen_whole = {
        number
        for number, seen in zip(points, views, strict=True)
        if seen == reconstruction.points3D[number].track.length()
    }
    assert 0 < len(seen_whole) < len(points)
    for key in of_files:
        if key[0] == "error" and key[1] not in seen_whole:
            of_files[key] = before[key]
    assert_same_numbers(after, of_files, 1e-8)  # two solves with arrays of other sizes
    changed = {key for key in after if (after[key] != before[key]).any()}
    images = [reconstruction.images[number] for number in config.images]
    may = {("frame", image.frame_id) for image in images} - {("frame", images[0].frame_id)}
    assert {key for key in changed if key[0] == "frame"} == may


def test_names_that_are_no_text_are_as_in_files(tmp_path):
    scene(1, 1, 3, points=20).write_text(tmp_path)
    file = tmp_path / "images.txt"
    file.write_bytes(file.read_bytes().replace(b"frame000001", b"fr\xe4me"))
    problem = jaxba.from_pycolmap(pycolmap.Reconstruction(tmp_path))
    assert problem.labels.names == jaxba.read_colmap(tmp_path).labels.names
    assert "fr\udce4me" in problem.labels.names[1]


def test_only_what_the_part_needs_is_read():
    reconstruction = with_short_tracks(scene(1, 1, 12))
    model = read_part(reconstruction, [1, 2], [3])
    seers = {element.image_id for element in reconstruction.points3D[3].track.elements}
    assert set(model.images) == {1, 2} | seers
    seen = {
        key.point3D_id
        for image in (1, 2)
        for key in reconstruction.images[image].points2D
        if key.has_point3D()
    }
    assert set(model.points["id"].tolist()) == seen | {3}
    for number in set(model.images) - {1, 2}:
        keys = model.images[number].keys
        at = np.flatnonzero(keys["point"] == 3)
        assert at.size == np.count_nonzero(keys["point"] < len(reconstruction.points3D) + 1) == 1
        np.testing.assert_array_equal(
            keys["xy"][at[0]], reconstruction.images[number].points2D[int(at[0])].xy
        )


def test_a_key_point_is_believed_where_a_track_says_something_else():
    reconstruction = scene(1, 1, 4, points=20)
    other = copy.deepcopy(reconstruction)
    key = next(at for at, key in enumerate(other.images[4].points2D) if key.point3D_id == 3)
    other.images[4].reset_point3D_for_point2D(key)
    config = pycolmap.BundleAdjustmentConfig()
    config.add_image(1)
    config.add_variable_point(3)
    views = [jaxba.from_pycolmap(of, config).num_observations for of in (reconstruction, other)]
    assert views[0] - views[1] == 1


@pytest.mark.filterwarnings("ignore::jaxba.ProblemWarning")
def test_what_is_left_out_of_a_part_is_said_of_the_reconstruction():
    reconstruction = scene(1, 1, 4, points=20)
    point = reconstruction.images[1].points2D[0].point3D_id
    reconstruction.point3D(point).xyz = [np.nan, 0, 0]
    config = pycolmap.BundleAdjustmentConfig()
    config.add_image(1)
    said = rf"^the reconstruction: 1 point left out, not finite \(point {point}\)$"
    with pytest.warns(jaxba.ProblemWarning, match=said):
        jaxba.from_pycolmap(reconstruction, config)


@pytest.mark.parametrize("change", ["pixel", "point", "image"])
def test_a_problem_of_another_reconstruction_is_refused(change):
    reconstruction = scene(1, 1, 4, points=20)
    other = copy.deepcopy(reconstruction)
    problem = jaxba.from_pycolmap(reconstruction)
    if change == "pixel":
        problem = problem.replace(observations=problem.observations + 0.01)
    if change == "point":
        other.delete_point3D(5)
    if change == "image":
        other = scene(1, 1, 3, points=20)
    with pytest.raises(jaxba.ProblemError, match="the problem is not one of this reconstruction"):
        update(other, problem)
