"""A part of a problem: what does not belong to it stays, bit for bit, and what does is solved as a
problem of its own.

COLMAP's own local bundle adjustment is the truth in tests/io/test_reconstruction.py.
"""

from __future__ import annotations

import numpy as np
import pytest

import jaxba
from jaxba.problem import geometry
from jaxba.problem.part import observed_part

CONFIG = jaxba.SceneConfig(cameras=12, points=120)
LOCAL = [2, 3, 5]


@pytest.fixture(scope="module")
def scene():
    return jaxba.random_scene(CONFIG, 0)


def seen_by(problem, images):
    return np.unique(problem.point_index[np.isin(problem.camera_index, images)])


def test_only_chosen_images_move_and_points_that_others_see_stay(scene):
    found = jaxba.solve(jaxba.part(scene, images=LOCAL)).problem
    moved = np.flatnonzero((found.cameras != scene.cameras).any(axis=1))
    assert moved.tolist() == LOCAL
    others = np.delete(np.arange(12), LOCAL)
    both = np.intersect1d(seen_by(scene, LOCAL), seen_by(scene, others))
    assert len(both)
    assert (found.points[both] == scene.points[both]).all()


def test_named_points_are_optimised_with_all_that_is_seen_of_them(scene):
    """The gradient of the whole cost by such a point is zero at the end, and the others do not
    move."""
    points = seen_by(scene, LOCAL)[:40]
    tight = jaxba.SolveOptions(tolerances=jaxba.Tolerances(ftol=1e-14, xtol=1e-12))
    found = jaxba.solve(jaxba.part(scene, images=LOCAL, points=points), options=tight).problem
    moved = np.flatnonzero((found.points != scene.points).any(axis=1))
    assert set(points) <= set(moved)

    def of_point(p):
        return 0.5 * np.sum(geometry.residuals(p)[np.asarray(p.point_index) == points[0]] ** 2)

    def shifted(axis, by):
        array = found.points.copy()
        array[points[0], axis] += by
        return of_point(found.replace(points=array))

    step = 1e-4
    slopes = [(shifted(axis, step) - shifted(axis, -step)) / (2 * step) for axis in range(3)]
    bends = [
        (shifted(axis, step) - 2 * of_point(found) + shifted(axis, -step)) / step**2
        for axis in range(3)
    ]
    assert (np.abs(slopes) < 1e-4 * np.array(bends)).all()


def test_ignored_points_and_short_tracks_do_not_count(scene):
    tracks = np.bincount(scene.point_index, minlength=120)
    least = int(np.median(tracks)) + 1
    found = jaxba.part(scene, ignored=[0, 1], min_track=least)
    counted = np.unique(found.point_index)
    assert counted.tolist() == [k for k in np.flatnonzero(tracks >= least) if k > 1]
    assert found.constants is None  # all images count, and so no point is seen in part


def test_a_shared_lens_is_refined_where_a_chosen_image_has_it():
    lenses = jaxba.Lenses(np.array([0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2]), np.ones((3, 3), bool))
    scene = jaxba.random_scene(CONFIG, 0)
    cameras = np.array(scene.cameras)
    cameras[:, 6:] = cameras[[0] * 4 + [4] * 4 + [8] * 4, 6:]
    scene = scene.replace(cameras=cameras, lenses=lenses)
    found = jaxba.part(scene, images=[0, 1, 4], points=seen_by(scene, [0, 1, 4]))
    assert np.asarray(found.lenses.free).all(axis=1).tolist() == [True, True, False]
    solved = jaxba.solve(found).problem
    assert (solved.cameras[:4, 6:] == solved.cameras[0, 6:]).all()
    assert (solved.cameras[8:] == scene.cameras[8:]).all()


@pytest.mark.slow
def test_few_observed_cameras_are_solved_without_the_others_to_the_same_end(scene):
    part = jaxba.hold(jaxba.part(scene, images=LOCAL), poses=[2])
    small = observed_part(part)
    assert small.problem.num_cameras == 3
    found = jaxba.solve(part)
    turn = {"rotations": part.cameras[5:6, :3], "covariance": 1e9 * np.eye(3)[None]}
    blocks = jaxba.with_rotation_priors(part, **turn, images=[5])  # with residuals nothing is cut
    assert observed_part(blocks).problem is blocks
    again = jaxba.solve(blocks)
    assert found.final_cost == pytest.approx(again.final_cost, rel=1e-4)
    assert geometry.cost(found.problem) == pytest.approx(found.final_cost, rel=1e-9)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"images": []}, "no observation is left"),
        ({"min_track": 99}, "no observation"),
        ({"images": [12]}, "no image 12"),
    ],
)
def test_a_part_of_nothing_is_one_line(scene, given, message):
    with pytest.raises(ValueError, match=message):
        jaxba.part(scene, **given)
