"""Keys of the file of `--constraints` for what was measured: rows of residuals, notes and errors of
one line."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from support import constrained

import jaxba
from jaxba import ProblemWarning, residuals, write_colmap
from jaxba.cli.common import UsageError
from jaxba.io.colmap.files import read_model, write_model
from jaxba.problem import geometry
from jaxba.problem.camera_models import CAMERA_MODELS
from jaxba.problem.labels import Labels
from jaxba.scenes import SceneConfig

NAMES = tuple(f"view{k}.jpg" for k in range(5))


@pytest.fixture
def problem() -> jaxba.BundleProblem:
    """Images with names, and ids from 1 for them and from 100 for points."""
    found = jaxba.random_scene(SceneConfig(5, 30, 150, noise=0.0), 3)
    return found.replace(labels=Labels(NAMES, np.arange(1, 6), np.arange(5), np.arange(100, 130)))


@pytest.fixture
def said(tmp_path, problem):
    """The problem with what a file says."""

    def read(text: str, **settings):
        (tmp_path / "c.yaml").write_text(text)
        return constrained(problem, (), None, str(tmp_path / "c.yaml"), **settings)

    return read


def data(problem: jaxba.BundleProblem) -> tuple[list[list[int]], dict[str, np.ndarray]]:
    """Indices and data of the only rows."""
    (rows,) = problem.residuals.rows
    return [x.tolist() for x in rows.index], dict(
        zip(rows.residual.data, map(np.asarray, rows.data), strict=True)
    )


def test_control_points_are_rows_of_points_by_id(said):
    places = "{103: [1, 2, 3], 7: [0, 0, 0], 129: [4, 5, 6]}"
    stddev = "[0.5, 1, [1, 2, 4]]"
    text = f"control_points: {{positions: {places}, stddev: {stddev}, loss: huber}}\n"
    with pytest.warns(
        ProblemWarning, match=r"c.yaml: control_points: left out positions of 1 point that .*: 7"
    ):
        found = said(text)
    index, of = data(found)
    assert index == [[3, 29]]
    assert of["position"].tolist() == [[1, 2, 3], [4, 5, 6]]
    assert of["whitening"].tolist() == [
        np.diag([2.0] * 3).tolist(),
        np.diag([1, 0.5, 0.25]).tolist(),
    ]
    assert found.residuals.rows[0].loss == jaxba.Loss("huber")
    with pytest.raises(
        UsageError, match="control_points: positions of 1 point that the problem does not have: 7"
    ):
        said(text, strict=True)


@pytest.mark.slow
def test_a_scale_bar_scales_a_scene_that_has_no_scale(said):
    item = "points: [100, 101], stddev: 0.001, length: 3"
    found = said(f"distances:\n- {{{item}}}\n- {{points: [100, 129], stddev: 0.001, length: 4}}\n")
    assert data(found)[0] == [[0, 0], [1, 29]]
    points = jaxba.solve(found, options=jaxba.SolveOptions(max_iterations=20)).problem.points
    assert np.linalg.norm(points[0] - points[1]) == pytest.approx(3, abs=1e-3)


def test_directions_of_gravity_are_rows_of_images_by_name_or_id(said):
    found = said(
        "gravity: {up: [0, 1, 0], directions: {view1.jpg: [0, -1, 0], 3: [0, -9, 1]}, stddev: "
        "0.02}\n"
    )
    index, of = data(found)
    assert index == [[1, 2]]
    assert of["direction"].tolist() == [[0, -1, 0], [0, -9, 1]]
    assert of["up"].tolist() == [[0, 1, 0]] * 2
    assert (of["sigma"] == 0.02).all()
    assert found.residuals.rows[0].residual.function == residuals.gravity.function


def test_relative_poses_have_quaternions_or_angle_axis_vectors(said):
    turn = Rotation.from_rotvec([0.1, -0.2, 0.3])
    x, y, z, w = turn.as_quat()
    item = f"translation: [1, 2, 3], stddev: [0.1, 0.5], rotation: [{w}, {x}, {y}, {z}]"
    other = "translation: [0, 0, 1], stddev: [1, 1], rotation: [0.1, -0.2, 0.3]"
    pairs = {"[view0.jpg, 3]": item, "[1, gone.jpg]": other, "[4, view1.jpg]": other}
    text = "".join(f"- {{images: {pair}, {numbers}}}\n" for pair, numbers in pairs.items())
    with pytest.warns(
        ProblemWarning, match="relative_poses: left out pairs of 1 image that .* have: gone.jpg"
    ):
        index, of = data(said(f"relative_poses:\n{text}"))
    assert index == [[0, 3], [2, 1]]
    np.testing.assert_allclose(of["rotation"], [turn.as_matrix()] * 2, atol=1e-12)
    assert of["whitening"][0].tolist() == np.diag([10.0, 10, 10, 2, 2, 2]).tolist()


@pytest.mark.parametrize("model", ["BAL", "SIMPLE_PINHOLE"])
def test_depth_maps_are_looked_up_at_pixels_and_find_their_scales(model, problem, tmp_path):
    """Maps with twice the depth and a half; one image has none, and one pixel of another has no
    depth."""
    width = 900
    height = 700
    scale = 2.0
    shift = 0.5
    if model == "SIMPLE_PINHOLE":
        cameras = np.hstack([problem.cameras[:, :7], np.tile([width / 2, height / 2], (5, 1))])
        kinds = (CAMERA_MODELS[model],)
        free = np.zeros((5, 3), bool)
        problem = problem.replace(
            cameras=cameras, lenses=jaxba.Lenses(np.arange(5, dtype=np.int32), free, None, kinds)
        )
    else:
        problem = problem.replace(cameras=problem.cameras * ([1.0] * 7 + [0, 0]))
    problem = problem.replace(observations=geometry.project(problem))
    pixel = problem.observations * ([1, -1] if model == "BAL" else 1) + (
        [width / 2, height / 2] if model == "BAL" else [0, 0]
    )
    column, row = np.floor(pixel).astype(int).T
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    (tmp_path / "maps").mkdir()
    for at in range(4):
        own = np.flatnonzero(inside & (problem.camera_index == at))[1 if at == 0 else 0 :]
        depths = np.zeros((height, width))
        depths[row[own], column[own]] = scale * geometry.depths(problem)[own] + shift
        np.save(tmp_path / "maps" / (f"view{at}.npy" if at % 2 else f"view{at}.jpg.npy"), depths)
    (tmp_path / "c.yaml").write_text("depths: {folder: maps, stddev: 0.1, loss: cauchy}\n")
    with pytest.warns(ProblemWarning, match="depths: left out 1 image without a map: view4.jpg"):
        found = constrained(problem, (), None, str(tmp_path / "c.yaml"))
    index, of = data(found)
    assert len(index[0]) == np.sum(inside & (problem.camera_index < 4)) - 1
    assert index[0] == index[2]
    ahead = dict(
        zip(
            zip(problem.camera_index, problem.point_index, strict=True),
            geometry.depths(problem),
            strict=True,
        )
    )
    truth = [scale * ahead[pair] + shift for pair in zip(index[0], index[1], strict=True)]
    np.testing.assert_allclose(of["measured"], truth)
    np.testing.assert_allclose(of["sigma"], 0.1 * of["measured"])
    start = found.residuals.blocks[0]
    assert start.shape == (4, 2)
    assert (np.abs(start[:, 0] - 2.15) < 0.15).all()


def test_depth_maps_are_looked_up_from_the_principal_points_of_a_model(problem, tmp_path):
    write_colmap(problem, tmp_path / "old")
    model = read_model(tmp_path / "old")
    move = np.array([40.0, -25.0])  # of principal points, and of all pixels with them
    cameras = {}
    for key, one in model.cameras.items():
        params = (one.params[0], *(one.params[1:3] + move), *one.params[3:])
        cameras[key] = replace(one, params=params, width=one.width + 99, height=one.height + 99)
    images = {key: replace(one, keys=one.keys.copy()) for key, one in model.images.items()}
    for image in images.values():
        image.keys["xy"] += move
    write_model(replace(model, cameras=cameras, images=images), tmp_path / "new", ".bin")
    for image in images.values():
        camera = cameras[image.camera]
        depths = np.zeros((camera.height, camera.width))
        column, row = np.floor(image.keys["xy"]).astype(int).T
        depths[row, column] = image.keys["point"]
        np.save(tmp_path / f"{image.name.decode()}.npy", depths)
    found = jaxba.read_problem(tmp_path / "new")
    constraints = tmp_path / "c.yaml"
    constraints.write_text("depths: {folder: ., stddev: 0.1}")
    index, of = data(jaxba.survey(found, constraints, model=tmp_path / "new").problem)
    assert len(index[0]) > found.num_observations / 2
    assert found.labels is not None
    np.testing.assert_array_equal(of["measured"], found.labels.points[index[1]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "control_points: 5",
            "control_points: must be a mapping with the keys positions, stddev, loss",
        ),
        (
            "control_points: {positions: {103: [1, 2]}}",
            "positions: 103: must be three numbers, not [1, 2]",
        ),
        (
            "control_points: {positions: {103: [1, 2, 3]}, align: true}",
            "control_points: unknown key align; there are",
        ),
        (
            "control_points: {positions: {7: [1, 2, 3]}}",
            "control_points: none of the points is in the problem: 7",
        ),
        (
            "control_points: {positions: {103: [1, 2, 3]}, stddev: [1, 2]}",
            "three for each of 1 points, not 2 values",
        ),
        ("gravity: {directions: {1: [0, 1, 0]}}", "gravity: 'up' is missing"),
        (
            "gravity: {up: 1, directions: {1: [0, 1, 0]}}",
            "gravity: up: must be three numbers, not 1",
        ),
        (
            "gravity: {up: [0, 0, 1], directions: [1]}",
            "directions: must be a mapping from images to [x, y, z]",
        ),
        (
            "distances: {points: [100, 101]}",
            "distances: must be a list of mappings, not {points: [100, 101]}",
        ),
        ("distances: [{points: [100, 101], length: 1}]", "distances: 'stddev' is missing"),
        (
            "distances: [{points: [100, 100], length: 1, stddev: 1}]",
            "points: must be two, not [100, 100]",
        ),
        (
            "distances: [{points: [100, 101], length: 1, stddev: 0}]",
            "100, 101: stddev: must be positive, not 0",
        ),
        (
            "distances: [{points: [100, 101], length: -1, stddev: 1}]",
            "100, 101: length: must be positive, not -1",
        ),
        (
            "relative_poses: [{images: [view0.jpg, 1], rotation: [0, 0, 0], translation: [0, 0, "
            "0], stddev: [1, 1]}]",
            "relative_poses: a pair has the same image twice",
        ),
        ("depths: {folder: [maps], stddev: 1}", "folder: must be a name, not"),
        (
            "distances: [{points: [100, 101], length: x, stddev: 1}]",
            "100, 101: length: must be a number, not x",
        ),
        (
            "relative_poses: [{images: [1, 2], rotation: [1, 2], translation: [0, 0, 0], stddev: "
            "[1, 1]}]",
            "relative_poses: 1, 2: rotation: must be 3 numbers or 4 numbers, not [1, 2]",
        ),
        (
            "relative_poses: [{images: [1, 2], rotation: [0, 0, 0, 0], translation: [0, 0, 0], "
            "stddev: [1, 1]}]",
            "relative_poses: 1, 2: rotation: must be a quaternion of length one, not [0, 0, 0, 0]",
        ),
        (
            "relative_poses: [{images: [1, 2], rotation: [1, 1, 0, 0], translation: [0, 0, 0], "
            "stddev: [1, 1]}]",
            "relative_poses: 1, 2: rotation: must be a quaternion of length one, not [1, 1, 0, 0]",
        ),
        (
            "gravity: {up: [0, 0, 1], directions: {1: [0, 1, 0], view1.jpg: [0, 0, 0]}}",
            "gravity: direction of gravity must be other than zero, not [0.0, 0.0, 0.0] (image 2 "
            "(view1.jpg))",
        ),
        (
            "gravity: {up: [0, 0, 0], directions: {1: [0, 1, 0]}}",
            "gravity: up of gravity must be other than zero, not [0.0, 0.0, 0.0]",
        ),
        ("depths: {folder: nowhere}", "depths: 'stddev' is missing"),
        (
            "depths: {folder: ., stddev: -1}",
            "depths: stddev: must be a positive number, or three, not -1",
        ),
        ("depths: {folder: bad, stddev: 1}", "view0.npy: no matrix of depths"),
    ],
)
def test_mistakes_are_one_line_that_names_the_key(text, message, said, tmp_path):
    (tmp_path / "bad").mkdir()
    for name in NAMES:
        np.save(tmp_path / "bad" / name.replace("jpg", "npy"), np.zeros(3))
    with pytest.raises(UsageError) as caught:
        said(text + "\n")
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("ignore::jaxba.ProblemWarning")
def test_a_folder_without_maps_is_an_error(said):
    with pytest.raises(UsageError, match=r"there is no folder .*nowhere"):
        said("depths: {folder: nowhere, stddev: 1}\n")
