"""PLY point clouds: an independent small parser finds the points and the camera centres."""

from __future__ import annotations

import gzip
import os
import struct

import numpy as np
import pytest

from jaxba.io import write_ply, write_problem
from jaxba.problem.bundle_problem import BundleProblem, ProblemError


def make_problem(num_cameras: int = 6, num_points: int = 30) -> BundleProblem:
    rng = np.random.default_rng(0)
    cameras = rng.normal(size=(num_cameras, 9))
    cameras[0, :3] = 0
    return BundleProblem.create(
        cameras, 1e5 * rng.normal(size=(num_points, 3)), [[1.0, 2.0]], [0], [0]
    )


def parse_ply(content: bytes) -> np.ndarray:
    """Vertices of a PLY file with the properties x, y, z (double) and three colours (uchar): shape
    (n, 6)."""
    header, body = content.split(b"end_header\n", 1)
    magic, form, *rest = header.decode("ascii").splitlines()
    assert magic == "ply"
    declarations = [line.split() for line in rest if not line.startswith("comment")]
    assert declarations[0][:2] == ["element", "vertex"]
    count = int(declarations[0][2])
    assert [words[1:] for words in declarations[1:]] == [["double", axis] for axis in "xyz"] + [
        ["uchar", colour] for colour in ("red", "green", "blue")
    ]
    assert form == "format binary_little_endian 1.0"
    assert len(body) == count * 27
    vertices = list(struct.iter_unpack("<3d3B", body))
    assert len(vertices) == count
    return np.array(vertices, dtype=np.float64)


def test_vertices_are_the_points_and_then_the_centres_that_cameras_map_to_zero(tmp_path):
    problem = make_problem()
    write_ply(problem, tmp_path / "scene.ply")
    vertices = parse_ply((tmp_path / "scene.ply").read_bytes())
    np.testing.assert_array_equal(vertices[:30, :3], problem.points)
    assert (vertices[:30, 3:] == [192, 192, 192]).all()
    assert (vertices[30:, 3:] == [0, 255, 0]).all()
    centres = vertices[30:, :3]
    for camera, centre in zip(np.asarray(problem.cameras), centres, strict=True):
        angle = np.linalg.norm(camera[:3])
        x, y, z = camera[:3] / max(float(angle), 1e-300)
        skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        rotation = np.eye(3) + np.sin(angle) * skew + (1 - np.cos(angle)) * skew @ skew
        np.testing.assert_allclose(rotation @ centre + camera[3:6], 0, atol=1e-14)


def test_a_camera_that_is_not_turned_stands_at_minus_its_translation(tmp_path):
    problem = make_problem()
    write_ply(problem, tmp_path / "scene.ply")
    centre = parse_ply((tmp_path / "scene.ply").read_bytes())[30, :3]
    np.testing.assert_array_equal(centre, -np.asarray(problem.cameras)[0, 3:6])


def test_the_suffix_chooses_the_format(tmp_path):
    problem = make_problem()
    write_problem(problem, tmp_path / "a.PLY")
    write_problem(problem, tmp_path / "a.ply.gz")
    write_problem(problem, tmp_path / "a.txt")
    assert parse_ply((tmp_path / "a.PLY").read_bytes()).shape == (36, 6)
    assert (
        gzip.decompress((tmp_path / "a.ply.gz").read_bytes()) == (tmp_path / "a.PLY").read_bytes()
    )
    assert (tmp_path / "a.txt").read_text().startswith("6 30 1\n")


@pytest.mark.parametrize("change", ["points", "cameras", "rotation"])
def test_positions_that_are_not_finite_are_refused_and_nothing_is_written(tmp_path, change):
    problem = make_problem()
    if change == "points":
        problem = problem.replace(points=np.full((30, 3), np.inf))
    elif change == "cameras":
        problem = problem.replace(cameras=np.full((6, 9), np.nan))
    else:
        problem = problem.replace(cameras=np.full((6, 9), 1e200))
    with pytest.raises(ProblemError, match="is not finite") as caught:
        write_ply(problem, tmp_path / "scene.ply")
    assert str(caught.value).isprintable()
    assert os.listdir(tmp_path) == []


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(ProblemError, match="No such file"):
        write_ply(make_problem(), tmp_path / "missing" / "scene.ply")
