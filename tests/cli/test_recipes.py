"""Commands that the documents recommend do what they are recommended for."""

from __future__ import annotations

import shlex
from pathlib import Path

import numpy as np
import pytest

import jaxba
from jaxba.cli.solve import run
from jaxba.problem import geometry
from jaxba.problem.similarity import umeyama

PAGE = Path(__file__).parents[2] / "docs" / "how-to" / "kitti.md"

STREET = jaxba.SceneConfig(
    cameras=16, points=400, mean_track=6.0, noise=0.15, k1=(0.0, 0.0),
    rotation_jitter=0.002, position_jitter=0.02,
    start_rotation=0.0, start_center=0.0, start_point=0.0, start_focal=0.0,
)  # fmt: skip
"""The start is the truth, and the camera looks ahead."""


@pytest.mark.slow
def test_the_recipe_for_kitti_keeps_a_path_that_is_right(tmp_path):
    street = jaxba.random_scene(STREET, 1)
    jaxba.write_bal(street, tmp_path / "start.txt")
    line = next(line for line in PAGE.read_text().splitlines() if line.startswith("jaxba-solve "))
    words = shlex.split(line)[2:]
    words = words[: words.index("--output")]
    true = geometry.camera_centers(street.cameras)

    def error(words: list[str]) -> float:
        """Of the aligned path, in steps between frames."""
        assert (
            run([str(tmp_path / "start.txt"), *words, "--output", str(tmp_path / "end.txt")]) == 0
        )
        found = geometry.camera_centers(jaxba.read_bal(tmp_path / "end.txt").cameras)
        return float(np.sqrt(np.mean((umeyama(found, true).points(found) - true) ** 2)))

    assert error(words) < 0.2 * error(
        [word for word in words if word not in ("--intrinsics", "fixed")]
    )
