"""Depth maps of any size of the shape of their images are read; what is not of them, or no depth,
is refused."""

from __future__ import annotations

import copy

import numpy as np
import pytest

import jaxba
from benchmarks.survey_scenes import Survey, depth_maps, draw, write
from jaxba import ProblemError


@pytest.fixture(scope="module")
def room() -> Survey:
    return draw("room", "depths", 1)


def scales(survey: Survey, maps: list[np.ndarray], folder) -> np.ndarray:
    """Scales of the images at the start, relative to their median."""
    changed = copy.copy(survey)
    changed.maps = maps
    file = write(changed, folder, bent=False)
    found = jaxba.survey(jaxba.read_colmap(folder / "model"), file, model=folder / "model").problem
    start = np.asarray(found.residuals.blocks[0])
    assert len(found.residuals.rows[0]) > 0.95 * survey.seen.size
    return start[:, 0] / np.median(start[:, 0])


@pytest.mark.parametrize("size", [(320, 240), (518, 392)])
def test_maps_of_another_size_are_looked_up_at_scaled_pixels(room, tmp_path, size):
    maps = depth_maps(room, size, lambda depth: 1.7 * depth, np.random.default_rng(0))
    np.testing.assert_allclose(scales(room, maps, tmp_path), 1.0, atol=0.03)


def on_their_side(depths: np.ndarray) -> np.ndarray:
    return np.rot90(depths).copy()


def cut(depths: np.ndarray) -> np.ndarray:
    return depths[:, 100:400].copy()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (on_their_side, "is 480 x 640, and its image 640 x 480: the map is on its side"),
        (cut, "is 300 x 480, and its image 640 x 480: the map is not of the whole image"),
    ],
)
def test_maps_of_another_shape_are_refused_with_both_sizes(room, tmp_path, change, message):
    maps = depth_maps(room, room.size, lambda depth: depth, np.random.default_rng(0))
    with pytest.raises(ProblemError, match=message):
        scales(room, [change(depths) for depths in maps], tmp_path)


@pytest.mark.parametrize("shift", [0.0, 0.3])
def test_disparities_are_not_taken_for_depths(room, tmp_path, shift):
    maps = depth_maps(room, room.size, lambda depth: 20 / depth + shift, np.random.default_rng(0))
    with pytest.raises(ProblemError, match="they seem to have disparities, not depths"):
        scales(room, maps, tmp_path)
