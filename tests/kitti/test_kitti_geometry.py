"""Tracks, key-frames, triangulation, starts and the problem made of them: on points that are known
exactly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxba.io.frames import Calibration
from jaxba.kitti.assemble import assemble
from jaxba.kitti.odometry import visual_odometry
from jaxba.kitti.options import Build
from jaxba.kitti.tracks import Tracks, choose, join_matches, make_tracks, parallax
from jaxba.kitti.triangulate import Observations, Views, triangulate, triangulate_robustly
from jaxba.problem import geometry
from jaxba.problem.bundle_problem import ProblemError

CALIBRATION = Calibration(700.0, 650.0, 600.0, 180.0)
NEARLY_ALL = Build(min_angle=1e-3)
PIXELS = 3 / CALIBRATION.fx


def street(views: int = 6, points: int = 40, seed: int = 0) -> tuple[np.ndarray, Views, np.ndarray]:
    """Poses (camera to world) of a bent drive far from the origin, the same as views, and points
    before all of them."""
    random = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(np.arange(views)[:, None] * [0.01, 0.05, -0.005]).as_matrix()
    centers = np.array([500.0, 10.0, -300.0]) + np.arange(views)[:, None] * [0.1, 0.02, 1.0]
    local = random.uniform([-6, -3, 12], [6, 2, 40], (points, 3))
    poses = np.concatenate([rotation, centers[:, :, None]], axis=2)
    inverse = rotation.transpose(0, 2, 1)
    return poses, Views(inverse, -np.einsum("nij,nj->ni", inverse, centers)), local + centers[0]


def sight(views: Views, points: np.ndarray) -> Observations:
    """Every point seen in every view."""
    count = len(views.rotation)
    camera = np.tile(np.arange(count), len(points))
    track = np.repeat(np.arange(len(points)), count)
    local = (
        np.einsum("nij,nj->ni", views.rotation[camera], points[track]) + views.translation[camera]
    )
    return Observations(camera, track, local[:, :2] / local[:, 2:])


def as_tracks(observations: Observations) -> Tracks:
    pixels = observations.rays * [CALIBRATION.fx, CALIBRATION.fy] + [CALIBRATION.cx, CALIBRATION.cy]
    return Tracks(observations.camera, observations.track, pixels)


# Tracks


def places(*counts: int) -> list[np.ndarray]:
    """Key-points whose pixel says which they are: (image, number)."""
    return [
        np.column_stack([np.full(n, float(i)), np.arange(float(n))]) for i, n in enumerate(counts)
    ]


def arrays(matches: dict) -> dict:
    return {pair: np.array(found) for pair, found in matches.items()}


def members(tracks: Tracks) -> set[tuple]:
    """The key-points of every track."""
    return {
        tuple(map(tuple, tracks.pixels[tracks.track == t].tolist())) for t in range(tracks.count)
    }


def test_matches_of_neighbours_and_over_gaps_make_one_track():
    matches = {(0, 1): [[0, 2]], (1, 2): [[0, 1], [2, 0]], (0, 2): [[2, 1]]}
    assert members(join_matches(places(3, 3, 3), arrays(matches))) == {
        ((0.0, 0.0), (1.0, 2.0), (2.0, 0.0)),
        ((0.0, 2.0), (1.0, 0.0), (2.0, 1.0)),
    }


def test_a_track_that_is_twice_in_an_image_is_split_into_the_chains_of_neighbours():
    """0:0 - 1:0 - 2:0 along neighbours, but 0:0 - 2:1 over the gap, and 2:1 - 3:1."""
    matches = {(0, 1): [[0, 0]], (1, 2): [[0, 0]], (0, 2): [[0, 1]], (2, 3): [[1, 1], [0, 0]]}
    assert members(join_matches(places(1, 1, 2, 2), arrays(matches))) == {
        ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0), (3.0, 0.0)),
        ((2.0, 1.0), (3.0, 1.0)),
    }


def test_no_track_is_ever_twice_in_an_image():
    """Random one-to-one matches contradict each other all the time."""
    random = np.random.default_rng(0)
    pairs = [(i, j) for j in range(8) for i in range(max(0, j - 3), j)]
    matches = {
        pair: np.stack([random.permutation(30)[:12], random.permutation(30)[:12]], axis=1)
        for pair in pairs
    }
    tracks = join_matches(places(*[30] * 8), matches)
    assert len(np.unique(tracks.track * 8 + tracks.image)) == len(tracks.track) > 0
    assert np.bincount(tracks.track).min() >= 2
    assert (np.diff(tracks.track * 8 + tracks.image) > 0).all()


def test_restricting_renumbers_images_and_drops_short_tracks():
    tracks = make_tracks(
        np.array([0, 1, 2, 1, 2, 0]), np.array([5, 5, 5, 9, 9, 7]), np.zeros((6, 2))
    )
    assert tracks.count == 2  # track 7 is seen once
    part = tracks.restrict([0, 2])
    assert part.image.tolist() == [0, 1]
    assert part.track.tolist() == [0, 0]
    assert [rows.tolist() for rows in tracks.shared(1, 2)] == [[1, 3], [2, 4]]


# Key-frames


def test_a_camera_that_only_turns_has_no_parallax():
    _, _, points = street()
    local = (points - points.mean(axis=0)) + [0, 0, 30]
    turn = Rotation.from_rotvec([0.02, 0.15, -0.03]).as_matrix()
    turned = local @ turn.T
    rays = [x[:, :2] / x[:, 2:] for x in (local, turned)]
    assert parallax(*rays, focal=700.0) < 1e-9
    assert 700 * np.median(np.linalg.norm(rays[0] - rays[1], axis=1)) > 50


def test_a_sideways_step_has_the_parallax_of_its_depth():
    """Points at depth 20 in a plane, seen after a step of 0.5: the rotation can hide some of 700 *
    0.5 / 20 pixels."""
    random = np.random.default_rng(1)
    local = np.column_stack(
        [random.uniform(-8, 8, (200, 2)), np.where(np.arange(200) % 2, 10.0, 1000.0)]
    )
    after = local - [0.5, 0, 0]
    found = parallax(local[:, :2] / local[:, 2:], after[:, :2] / after[:, 2:], 700.0)
    assert 10 < found < 35


def test_automatic_keyframes_skip_frames_that_stand_still():
    _, views, points = street(views=6, points=200)
    still = [0, 0, 0, 1, 2, 2, 3, 4, 5, 5]
    views = Views(views.rotation[still], views.translation[still])
    tracks = as_tracks(sight(views, points))
    chosen = choose(tracks, 10, "auto", CALIBRATION, tuple(range(10)))
    assert len(chosen) >= 2
    assert not {1, 2, 5, 9} & set(chosen)  # the frames whose pose is that of the frame before
    assert choose(tracks, 10, "4", CALIBRATION, tuple(range(10))) == [0, 4, 8]
    assert choose(tracks, 10, "all", CALIBRATION, tuple(range(10))) == list(range(10))
    with pytest.raises(ProblemError, match="hardly moves in frames 0 to 2"):
        choose(tracks.restrict([0, 1, 2]), 3, "auto", CALIBRATION, (0, 1, 2))
    with pytest.raises(
        ProblemError, match="--keyframes 99 leaves one key-frame of 10 in frames 0 to 9"
    ):
        choose(tracks, 10, "99", CALIBRATION, tuple(range(10)))
    for choice in ("0", "some", "-1", "1.5"):
        with pytest.raises(ProblemError, match="--keyframes must be"):
            choose(tracks, 10, choice, CALIBRATION, tuple(range(10)))


def test_keyframes_that_share_too_little_are_named():
    tracks = make_tracks(
        np.repeat([0, 1, 1, 2], 30),
        np.repeat([0, 100], 60) + np.tile(np.arange(30), 4),
        np.zeros((120, 2)),
    )
    with pytest.raises(ProblemError, match="key-frames 7 and 9 share 0 tracks"):
        choose(tracks, 3, "2", CALIBRATION, (7, 8, 9))


# Visual odometry


FORWARD = (0.3, 0.0, 1.0)


def drive(
    steps: list[float],
    links: list[list[int]],
    direction: tuple[float, ...] = FORWARD,
    seed: int = 0,
) -> Tracks:
    """Tracks of a drive by these steps: 80 points ahead for every list of views that see them, to
    0.1 pixels."""
    random = np.random.default_rng(seed)
    places = np.concatenate([[0.0], np.cumsum(steps)])[:, None] * direction
    image = []
    track = []
    pixels = []
    for link, views in enumerate(links):
        points = places[views[0]] + random.uniform([-8, -4, 10], [8, 3, 30], (80, 3))
        for view in views:
            local = points - places[view]
            rays = local[:, :2] / local[:, 2:]
            seen = rays * [CALIBRATION.fx, CALIBRATION.fy] + [CALIBRATION.cx, CALIBRATION.cy]
            image.append(np.full(80, view))
            track.append(80 * link + np.arange(80))
            pixels.append(seen + 0.1 * random.standard_normal(seen.shape))
    return make_tracks(*map(np.concatenate, (image, track, pixels)))


def steps_of(views: Views) -> np.ndarray:
    """Lengths of the steps between views, the first one 1."""
    lengths = np.linalg.norm(np.diff(views.centers(), axis=0), axis=1)
    return lengths / lengths[0]


def test_the_few_known_points_that_two_views_share_give_the_length_of_the_step():
    """View 4 is 2.5 steps away from view 3 and knows 8 points of it, too few to be placed by
    them."""
    tracks = drive([1.0, 1.0, 1.0, 2.5], [[0, 1, 2, 3], [3, 4], [0, 1, 2, 3, 4]])
    tracks = tracks.keep(tracks.track < 160 + 8)
    found, restarts = visual_odometry(tracks, 5, CALIBRATION, Build(), tuple(range(5)))
    assert restarts == (4,)
    np.testing.assert_allclose(steps_of(found), [1, 1, 1, 2.5], rtol=0.03)


def test_without_known_points_a_step_has_the_speed_of_the_steps_before():
    """View 4 is three frames after view 3 and shares no known point with it."""
    tracks = drive([1.0, 1.0, 1.0, 3.0], [[0, 1, 2, 3], [3, 4]])
    found, restarts = visual_odometry(tracks, 5, CALIBRATION, Build(), (0, 1, 2, 3, 6))
    assert restarts == (4,)
    np.testing.assert_allclose(steps_of(found), [1, 1, 1, 3], rtol=0.03)


def test_a_stop_without_known_points_leaves_the_scale():
    """Views 3 to 5 stand in one place and share new points only, as behind a lorry that passes."""
    tracks = drive([1.0, 1.0, 1.0, 0.0, 0.0, 1.0, 1.0], [[0, 1, 2, 3], [3, 4], [4, 5], [5, 6, 7]])
    found, restarts = visual_odometry(tracks, 8, CALIBRATION, Build(), tuple(range(8)))
    assert restarts[:3] == (4, 5, 6)
    np.testing.assert_allclose(steps_of(found), [1, 1, 1, 0, 0, 1, 1], rtol=0.05, atol=1e-9)


@pytest.mark.parametrize("seed", range(4))
def test_two_views_far_from_all_points_have_a_start(seed):
    """The median depth is 67 baselines: OpenCV takes points beyond 50 to be nowhere."""
    tracks = drive([0.3], [[0, 1], [0, 1], [0, 1]], (1.0, 0.0, 0.0), seed)
    found, _ = visual_odometry(tracks, 2, CALIBRATION, Build(), (0, 1))
    np.testing.assert_allclose(found.centers()[1], [1, 0, 0], atol=0.2)


def test_wrong_matches_of_the_first_views_do_not_make_the_start():
    """Views 0 and 1 share 40 matches that fit no motion well; those of the views after are good."""
    good = drive([1.0] * 5, [[1, 2, 3], [1, 2, 3, 4, 5], [0, 1, 2]])
    wrong = np.random.default_rng(0).uniform(0, 400, (80, 2))
    tracks = make_tracks(
        np.concatenate([good.image, np.repeat([0, 1], 40)]),
        np.concatenate([good.track, good.count + np.tile(np.arange(40), 2)]),
        np.concatenate([good.pixels, wrong]),
    )
    found, _ = visual_odometry(tracks, 6, CALIBRATION, Build(), tuple(range(6)))
    np.testing.assert_allclose(steps_of(found), np.ones(5), rtol=0.05)


# Triangulation


def test_exact_rays_give_exact_points():
    _, views, points = street()
    observations = sight(views, points)
    found = triangulate(views, observations)
    np.testing.assert_allclose(found.points, points, rtol=1e-9)
    assert found.error.max() < 1e-12
    local = np.einsum("nij,nj->ni", views.rotation[observations.camera], points[observations.track])
    np.testing.assert_allclose(
        found.depth, (local + views.translation[observations.camera])[:, 2], rtol=1e-8
    )


def test_noisy_rays_give_the_least_squares_point():
    """The same minimum by SciPy."""
    _, views, points = street(points=5)
    observations = sight(views, points)
    rays = observations.rays + 1e-3 * np.random.default_rng(2).standard_normal(
        observations.rays.shape
    )
    found = triangulate(views, Observations(observations.camera, observations.track, rays))
    for track in range(5):
        rows = observations.track == track

        def residual(x, rows=rows):
            local = (
                views.rotation[observations.camera[rows]] @ x
                + views.translation[observations.camera[rows]]
            )
            return (local[:, :2] / local[:, 2:] - rays[rows]).ravel()

        best = least_squares(residual, points[track], xtol=1e-15, ftol=1e-15, gtol=1e-15)
        cost = 0.5 * (found.error[rows] ** 2).sum()
        assert cost == pytest.approx(best.cost, rel=1e-6)


def test_the_angle_is_that_between_the_farthest_views():
    """Two cameras one apart, a point at depth d on the perpendicular through the middle: 2 atan(1 /
    2d)."""
    views = Views(np.tile(np.eye(3), (2, 1, 1)), np.array([[0.5, 0, 0], [-0.5, 0, 0]]))
    depth = np.array([3.0, 10.0])
    found = triangulate(views, sight(views, np.array([[0, 0, 3.0], [0, 0, 10.0]])))
    np.testing.assert_allclose(found.angle, np.rad2deg(2 * np.arctan(0.5 / depth)), rtol=1e-9)


def test_filters_refuse_points_behind_far_and_wrong():
    _, views, points = street(points=4)
    focal = 700.0
    behind = points.copy()
    far = points.copy()
    behind[0] = points[0] - [0, 0, 200]
    far[1] = points[1] + [0, 0, 5000]
    where = np.array([behind[0], far[1], points[2], points[3]])
    observations = sight(views, where)
    rays = observations.rays.copy()
    wrong = np.flatnonzero((observations.track == 2) & (observations.camera == 3))
    rays[wrong] += 0.1
    spoiled = Observations(observations.camera, observations.track, rays)
    good = triangulate(views, spoiled).good(spoiled.track, 1.0, 3.0 / focal)
    assert good.tolist() == [False, False, False, True]


def test_one_wrong_observation_costs_a_long_track_only_itself():
    _, views, points = street(views=8, points=3)
    observations = sight(views, points)
    rays = observations.rays.copy()
    wrong = np.flatnonzero((observations.track == 1) & (observations.camera == 7))
    rays[wrong] += 6 / 700
    spoiled = Observations(observations.camera, observations.track, rays)
    found, keep = triangulate_robustly(views, spoiled, 1.0, PIXELS)
    assert np.flatnonzero(~keep).tolist() == wrong.tolist()
    np.testing.assert_allclose(found, points, rtol=1e-6)


def test_no_tracks_are_no_error():
    _, views, _ = street()
    empty = Observations(np.empty(0, int), np.empty(0, int), np.empty((0, 2)))
    points, keep = triangulate_robustly(views, empty, 1.0, PIXELS)
    assert points.shape == (0, 3)
    assert keep.shape == (0,)


# The problem


def test_the_problem_reprojects_exactly_through_bals_camera():
    """The camera of BAL looks down -z with y up; fy differs from fx."""
    _, views, points = street()
    observations = sight(views, points)
    problem = assemble(as_tracks(observations), views, CALIBRATION, (3, 4, 5, 6, 7, 9), NEARLY_ALL)
    assert (problem.num_points, problem.num_observations) == (len(points), len(observations.track))
    np.testing.assert_allclose(geometry.residuals(problem), 0, atol=1e-6)
    np.testing.assert_allclose(
        problem.observations, CALIBRATION.fx * observations.rays * [1, -1], atol=1e-9
    )
    assert (geometry.depths(problem) > 0).all()
    assert (problem.cameras[:, 6:] == [CALIBRATION.fx, 0, 0]).all()


def test_cameras_and_poses_are_the_same_thing():
    poses, views, points = street()
    made = assemble(
        as_tracks(sight(views, points)), views, CALIBRATION, tuple(range(6)), NEARLY_ALL
    )
    np.testing.assert_allclose(geometry.camera_poses(np.asarray(made.cameras)), poses, atol=1e-9)


def test_a_frame_without_points_is_named():
    _, views, points = street()
    tracks = as_tracks(sight(views, points))
    lonely = tracks.keep((tracks.image != 4) | (tracks.track < 9))
    with pytest.raises(ProblemError, match="frame 40 sees 9 good ones, at least 10"):
        assemble(lonely, views, CALIBRATION, (0, 10, 20, 30, 40, 50), NEARLY_ALL)
