"""Random scenes of the game: shapes, costs by NumPy (`geometry`), and what a policy is told of
them."""

from __future__ import annotations

import chex
import jax
import numpy as np
import pytest
from tiny_game import KIND, grid, problem_of

from jaxba.game.random_scenes import (
    MIN_VIEWS,
    MOST_CAMERAS,
    MOST_POINTS,
    PAPER_START,
    SceneClass,
    make_scenes,
)
from jaxba.game.scene_bank import info_of, initial_costs
from jaxba.problem import geometry

LARGE = pytest.param(SceneClass(MOST_CAMERAS, MOST_POINTS), marks=pytest.mark.slow, id="large")
"""The largest class of scenes; forty of them are 1.1 million slots."""


@pytest.mark.parametrize(
    "kind", [KIND, pytest.param(SceneClass(6, 10, "paper"), id="paper"), LARGE]
)
def test_scenes_have_the_shape_of_their_class_and_enough_views(kind):
    scenes = make_scenes(kind, jax.random.key(1), 40)
    slots = kind.cameras * (kind.points + 1)
    shapes = [x.shape for x in scenes]
    assert shapes == [(40, 9, kind.cameras), (40, 3, kind.points + 1), (40, 2, slots), (40, slots)]
    assert all(np.isfinite(x).all() for x in scenes[:3])
    mask = np.asarray(scenes.mask)
    assert (
        np.asarray(scenes.pixels)[np.broadcast_to(~mask[:, None], scenes.pixels.shape)] == 0
    ).all()
    assert not mask.reshape(40, kind.cameras, -1)[:, :, -1].any()  # the empty point
    seen = grid(kind, scenes)
    views = seen.sum(axis=1)
    observed = seen.sum(axis=2)
    assert (views[views > 0] >= 2).all()
    assert (observed[observed > 0] >= MIN_VIEWS).all()
    if kind.family == "paper":
        assert seen.all()
    else:
        assert len({s.sum() for s in seen}) > 5  # sizes differ


@pytest.mark.parametrize("sizes", [(MOST_CAMERAS + 1, 40), (10, MOST_POINTS + 1), (3, 40), (10, 9)])
def test_a_class_that_is_too_large_or_too_small_is_refused(sizes):
    with pytest.raises(
        ValueError, match="a class of scenes has 4 to 56 cameras and 10 to 510 points, not"
    ):
        SceneClass(*sizes)


@pytest.mark.parametrize("kind", [KIND, pytest.param(SceneClass(6, 10, "paper"), id="paper")])
def test_the_cost_of_a_start_is_what_numpy_says(kind):
    scenes = make_scenes(kind, jax.random.key(2), 40)
    found = np.asarray(initial_costs(kind, scenes))
    tried = 0
    for k in range(12):
        if not grid(kind, scenes)[k].any():
            assert found[k] == 0
            continue
        np.testing.assert_allclose(found[k], geometry.cost(problem_of(kind, scenes, k)), rtol=1e-9)
        tried += 1
    assert tried >= 6


def test_the_paper_s_cameras_stand_at_random_around_its_points():
    """In all directions, before all points, with focal length 500."""
    scenes = make_scenes(SceneClass(6, 10, "paper"), jax.random.key(3), 40)
    cameras = np.asarray(scenes.cameras)
    points = np.asarray(scenes.points)[:, :, :-1]
    centers = np.stack([geometry.camera_centers(c.T) for c in cameras]).reshape(-1, 3)
    distance = np.linalg.norm(centers, axis=1)
    assert 8.5 < distance.mean() < 11  # 9 and its error
    # 240 directions; sigma of a mean 0.04
    assert (np.abs((centers / distance[:, None]).mean(axis=0)) < 0.15).all()
    assert (cameras[:, 6:] == np.array([500, 0, 0])[:, None]).all()
    assert 0.95 < np.std(points) / np.hypot(4 / np.sqrt(12), PAPER_START[2]) < 1.05


def test_the_same_key_makes_the_same_scenes_and_another_one_others():
    first, again, other = (make_scenes(KIND, jax.random.key(k), 40) for k in (7, 7, 8))
    chex.assert_trees_all_equal(first, again, strict=True)
    assert not np.allclose(first.cameras, other.cameras)
    assert len({c.tobytes() for c in np.asarray(first.cameras)}) == 40


def test_what_a_policy_is_told_of_a_scene_is_true():
    scenes = make_scenes(KIND, jax.random.key(1), 40)
    cost = initial_costs(KIND, scenes)
    info = info_of(KIND, scenes, cost, 33)
    for k, seen in enumerate(grid(KIND, scenes)):
        if not seen.any():
            continue
        assert int(info.observations[k]) == seen.sum()
        assert int(info.cameras[k]) == seen.any(axis=1).sum()
        assert int(info.points[k]) == seen.any(axis=0).sum()
        np.testing.assert_allclose(
            info.focal[k], np.median(np.asarray(scenes.cameras)[k, 6, seen.any(axis=1)])
        )
        assert int(info.max_iterations[k]) == 33
        assert info.cost[k] == cost[k]
