"""What files hold for looking at: COLMAP's colours and sizes, names; and one line where that
fails."""

from __future__ import annotations

import numpy as np
import pytest

import jaxba
from jaxba.cli import solve, view
from jaxba.io.colmap.read import read_colmap_with_looks
from jaxba.viewer.sources import open_all


@pytest.fixture(scope="module")
def problem():
    return jaxba.random_scene(jaxba.SceneConfig(cameras=6, points=60), 0)


@pytest.fixture(scope="module")
def model(problem, tmp_path_factory):
    folder = tmp_path_factory.mktemp("model") / "sparse"
    jaxba.write_problem(problem, f"{folder}/")
    return str(folder)


def test_a_model_has_its_problem_and_names(model, problem):
    read, looks = read_colmap_with_looks(model)
    np.testing.assert_array_equal(read.points, jaxba.read_problem(model).points)
    assert looks.colours is not None
    assert (looks.colours.shape, looks.sizes.shape) == ((read.num_points, 3), (read.num_cameras, 2))
    (shown,) = open_all([model])
    assert shown.name == "sparse"
    assert shown.name_of(2) == read.labels.names[2]


@pytest.mark.extra
def test_colours_and_sizes_are_those_that_pycolmap_reads(model, tmp_path):
    pycolmap = pytest.importorskip("pycolmap", reason="needs the extra: pip install jaxba[ceres]")
    reconstruction = pycolmap.Reconstruction(model)
    for number, point in reconstruction.points3D.items():
        point.color = np.array([number % 256, 3, 250 - number % 200], np.uint8)
    reconstruction.write(str(tmp_path))
    problem, looks = read_colmap_with_looks(str(tmp_path))
    assert looks.colours is not None
    for at, number in enumerate(problem.labels.points.tolist()):
        np.testing.assert_array_equal(looks.colours[at], reconstruction.points3D[number].color)
    for at, number in enumerate(problem.labels.images.tolist()):
        camera = reconstruction.images[number].camera
        np.testing.assert_array_equal(looks.sizes[at], [camera.width, camera.height])
        np.testing.assert_allclose(
            looks.principal[at], [camera.principal_point_x, camera.principal_point_y]
        )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "name a problem"),
        (("no.npz",), "cannot read no.npz"),
        (("no.txt", "--images", "nowhere"), "--images nowhere: is no folder"),
    ],
)
def test_jaxba_view_says_in_one_line_what_is_wrong(words, message, capsys, monkeypatch):
    monkeypatch.setattr(view.common, "check_extra", lambda module: None)
    assert view.run(words) == 2
    said = capsys.readouterr().err
    assert message in said.lower()
    assert said.count("\n") == 1


def test_a_recording_is_named_npz(capsys):
    assert solve.run(["no.txt", "--record", "run.txt"]) == 2
    assert "a recording ends in .npz" in capsys.readouterr().err


@pytest.mark.extra
def test_jaxba_solve_records_what_jaxba_view_opens(model, tmp_path, capsys):
    path = str(tmp_path / "run.npz")
    assert solve.run([model, "--max-iterations", "2", "--record", path]) == 0
    assert f"wrote {path}" in capsys.readouterr().out
    (shown,) = open_all([path])
    assert shown.recording.last == 2
    assert shown.names is not None


def test_without_viser_a_line_says_what_to_install(monkeypatch, capsys):
    import sys

    for name in [name for name in sys.modules if name.startswith("jaxba.viewer.")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert view.run(["no.txt"]) == 2
    assert "pip install jaxba[view]" in capsys.readouterr().err
    with pytest.raises(ImportError, match=r"pip install jaxba\[view\]"):
        jaxba.view(jaxba.random_scene(jaxba.SceneConfig(cameras=3, points=20), 0))
