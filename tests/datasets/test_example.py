"""The problem that comes with the package."""

from __future__ import annotations

import numpy as np

import jaxba
from jaxba.datasets import EXAMPLE
from jaxba.datasets.bal.paths import resolve

SCENE = jaxba.SceneConfig(
    **{"cameras": 24, "points": 1600, "observations": 7200, "gap_share": 0.5, "noise": 0.65},
    **{"image_width": 768.0, "image_height": 1024.0, "focal": (395.0, 410.0), "k1": (-0.02, 0.0)},
    **{"outlier_share": 0.005, "outlier_size": 20.0, "start_drift": 0.003, "start_rotation": 0.01},
    **{"start_center": 0.1, "start_point": 0.03, "start_focal": 0.03},
)


def test_the_example_is_a_random_scene_rounded():
    found = jaxba.example_problem()
    scene = jaxba.random_scene(SCENE, seed=0)
    np.testing.assert_allclose(found.observations, scene.observations, atol=0.0051)
    np.testing.assert_allclose(found.cameras, scene.cameras, atol=1e-7)
    np.testing.assert_allclose(found.points, scene.points, atol=1e-5)
    np.testing.assert_array_equal(found.camera_index, scene.camera_index)
    np.testing.assert_array_equal(found.point_index, scene.point_index)
    assert EXAMPLE.stat().st_size < 150_000


def test_a_file_of_its_name_comes_first(tmp_path, monkeypatch):
    assert resolve("example") == str(EXAMPLE)
    monkeypatch.chdir(tmp_path)
    (tmp_path / "example").write_text("mine")
    assert resolve("example") == "example"
