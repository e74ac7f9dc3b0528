"""nerfstudio's cameras: points that OpenGL's camera and OpenCV's distortion project are at the
problem's pixels."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import support
from colmap_model import TextModel
from foreign_scene import Lens, Scene, write_opensfm

import jaxba
from jaxba import ProblemError, read_colmap, write_transforms
from jaxba.cli.solve import run
from jaxba.problem import geometry

cv2 = pytest.importorskip("cv2", reason="the extra kitti is not installed")

LENSES = {
    "RADIAL": "7 RADIAL 1280 960 700 640 480 -0.03 0.01",
    "OPENCV": "7 OPENCV 1280 960 700 720 650 470 -0.03 0.01 0.002 -0.001",
    "OPENCV_FISHEYE": "7 OPENCV_FISHEYE 1280 960 700 720 650 470 0.03 -0.01 0.002 0.001",
    "SIMPLE_RADIAL_FISHEYE": "7 SIMPLE_RADIAL_FISHEYE 1280 960 700 640 480 0.03",
}


def pixels_of(document: dict, points: np.ndarray) -> dict[str, np.ndarray]:
    """Pixels of points in each frame of a file, from its own keys."""
    found = {}
    for frame in document["frames"]:
        lens = document | frame
        local = np.linalg.inv(frame["transform_matrix"]) @ np.vstack(
            [points.T, np.ones(len(points))]
        )
        matrix = np.array([[lens["fl_x"], 0, lens["cx"]], [0, lens["fl_y"], lens["cy"]], [0, 0, 1]])
        # OpenCV's camera looks along z, with y down
        ahead = local[:3].T * [1, -1, -1]
        none = np.zeros(3)
        if document["camera_model"] == "OPENCV_FISHEYE":
            radial = np.array([lens.get(f"k{k}", 0.0) for k in (1, 2, 3, 4)])
            pixels, _ = cv2.fisheye.projectPoints(ahead[None], none, none, matrix, radial)
        else:
            assert document["camera_model"] == "OPENCV"
            bent = np.array([lens["k1"], lens["k2"], lens.get("p1", 0.0), lens.get("p2", 0.0)])
            pixels, _ = cv2.projectPoints(ahead, none, none, matrix, bent)
        found[frame["file_path"]] = pixels.reshape(-1, 2)
    return found


def check(file: Path, problem: jaxba.BundleProblem) -> dict:
    """The file, whose pixels are those of a problem with pixels from the corner."""
    assert problem.labels is not None
    document = json.loads(file.read_text())
    found = pixels_of(document, np.asarray(problem.points))
    assert list(found) == [f"images/{name}" for name in problem.labels.names]
    expected = geometry.project(problem)
    at = np.asarray(problem.camera_index)
    pixels = np.stack(list(found.values()))[at, np.asarray(problem.point_index)]
    np.testing.assert_allclose(pixels, expected, atol=1e-8)
    return document


@pytest.mark.parametrize("kind", LENSES)
def test_points_are_at_the_pixels_of_the_problem(kind, tmp_path):
    model = TextModel()
    model.cameras[1] = LENSES[kind]
    folder = model.write(tmp_path / "model")
    moved = jaxba.perturb(read_colmap(folder), seed=1, rotation_sigma=0.01, translation_sigma=0.1)
    write_transforms(moved, tmp_path / "transforms.json", like=folder)
    jaxba.write_colmap(moved, tmp_path / "moved", like=folder)
    document = check(
        tmp_path / "transforms.json", read_colmap(tmp_path / "moved", refine_principal_point=True)
    )
    assert (document["w"], document["h"]) == (1280, 960)
    assert "fl_x" not in document["frames"][0]


def test_images_of_several_cameras_have_their_own_lens(tmp_path):
    model = TextModel()
    model.cameras.append("8 PINHOLE 800 600 500 510 400 300")
    model.heads[2] = model.heads[2].replace(" 7 view", " 8 view")
    folder = model.write(tmp_path / "model")
    problem = read_colmap(folder, refine_principal_point=True)
    write_transforms(problem, tmp_path / "transforms.json", like=folder)
    document = check(tmp_path / "transforms.json", problem)
    assert [frame["w"] for frame in document["frames"]] == [1280, 1280, 800, 1280, 1280, 1280]


def test_a_problem_without_names_gets_those_that_a_new_model_would(tmp_path):
    jaxba.write_problem(support.tiny(), tmp_path / "a.json")
    jaxba.write_colmap(support.tiny(), tmp_path / "model")
    check(tmp_path / "a.json", read_colmap(tmp_path / "model", refine_principal_point=True))


def test_the_command_writes_the_cameras_of_a_model(tmp_path, capsys):
    folder = TextModel().write(tmp_path / "model")
    file = tmp_path / "transforms.json"
    arguments = [str(folder), "--max-iterations", "2", "--output"]
    assert run([*arguments, str(file)]) == 0
    assert "note" not in capsys.readouterr().out
    assert run([*arguments, str(tmp_path / "solved")]) == 0
    check(file, read_colmap(tmp_path / "solved", refine_principal_point=True))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["7 FOV 1280 960 700 700 640 480 0.1"], "nerfstudio has no camera model FOV"),
        (
            [
                "7 OPENCV_FISHEYE 1280 960 700 700 640 480 0 0 0 0",
                "8 SIMPLE_PINHOLE 800 600 500 400 300",
            ],
            "nerfstudio has one camera model in a file, not OPENCV_FISHEYE, SIMPLE_PINHOLE",
        ),
    ],
)
def test_lenses_that_it_does_not_have_are_refused_before_the_solve(
    lines, message, tmp_path, capsys
):
    model = TextModel()
    model.cameras[1:] = lines
    model.heads[2] = (
        model.heads[2].replace(" 7 view", " 8 view") if len(lines) > 1 else model.heads[2]
    )
    file = tmp_path / "transforms.json"
    assert run([str(model.write(tmp_path / "model")), "--output", str(file)]) == 2
    assert capsys.readouterr().err == f"error: cannot write {file}: {message}\n"
    with pytest.raises(ProblemError, match=message):
        write_transforms(read_colmap(tmp_path / "model"), file)
    assert not file.exists()


def test_a_problem_in_a_json_file_is_not_replaced_by_its_cameras(tmp_path, capsys):
    path = write_opensfm(tmp_path, Scene([Lens(cx=800.0, cy=600.0)], [0, 0, 0]), ["perspective"])
    before = path.read_bytes()
    assert run([str(path), "--output", str(path)]) == 2
    assert "reconstruction.json" in capsys.readouterr().err
    assert path.read_bytes() == before
