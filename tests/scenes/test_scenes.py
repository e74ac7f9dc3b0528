"""Random scenes: exact counts, everything in sight, noise as asked, and problems that can be
solved."""

from __future__ import annotations

import os
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.problem.geometry import camera_centers, cost, depths, project, residuals
from jaxba.scenes import LIKE, SceneConfig, random_scene, random_scene_with_truth, scene_like
from jaxba.scenes.tracks import track_lengths

DATA = os.environ.get("JAXBA_DATA")
needs_data = pytest.mark.skipif(DATA is None, reason="JAXBA_DATA names no folder of real problems")

TRAJECTORIES = ["forward", "lateral", "orbit", "photos"]
MIDDLE = SceneConfig(cameras=60, points=1500, observations=6600)
SMALL_NAMES = ["tiny", "paper", "random-150", "ladybug-49", "trafalgar-21"]


def middle(trajectory: str, **changes) -> SceneConfig:
    return replace(MIDDLE, trajectory=trajectory, **changes)


# Counts


@pytest.mark.parametrize("name", SMALL_NAMES)
def test_a_named_scene_has_exactly_its_counts(name):
    config = scene_like(name)
    scene = random_scene(config, 0)
    assert scene.num_cameras == config.cameras
    assert scene.num_points == config.points
    assert scene.num_observations == config.total


def test_the_named_scenes_have_the_sizes_of_bal():
    sizes = {name: (config.cameras, config.points, config.total) for name, config in LIKE.items()}
    assert sizes == {
        "tiny": (6, 40, 200),
        "paper": (10, 10, 100),
        "random-150": (150, 20000, 88000),
        "ladybug-49": (49, 7776, 31843),
        "trafalgar-21": (21, 11315, 36455),
        "dubrovnik-356": (356, 226730, 1255268),
        "ladybug-1197": (1197, 126327, 563734),
        "venice-1778": (1778, 993923, 5001946),
        "final-13682": (13682, 4456117, 28987644),
    }


def test_a_scene_of_a_thousand_cameras_is_exact_and_whole():
    config = scene_like("ladybug-1197")
    start, truth = random_scene_with_truth(config, 0)
    assert (start.num_cameras, start.num_points, start.num_observations) == (1197, 126327, 563734)
    assert depths(truth).min() > 0
    assert np.bincount(start.camera_index, minlength=1197).min() >= 4
    assert np.bincount(start.point_index, minlength=126327).min() >= 2


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
@pytest.mark.parametrize(
    "size", [(2, 4, 8), (3, 12, 30), (5, 20, 60), (12, 30, 150), (50, 500, 2000), (300, 1000, 3000)]
)
def test_every_size_has_its_counts_no_double_views_and_tracks_of_two_or_more(trajectory, size):
    cameras, points, observations = size
    config = SceneConfig(cameras, points, observations, trajectory=trajectory)
    for seed in range(3):
        scene = random_scene(config, seed)
        pairs = scene.point_index.astype(np.int64) * cameras + scene.camera_index
        assert len(pairs) == observations
        assert (np.diff(pairs) > 0).all()  # sorted by point and camera, none twice
        assert np.bincount(scene.point_index, minlength=points).min() >= 2


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_every_camera_sees_four_points(trajectory):
    for config in (middle(trajectory), SceneConfig(1000, 2500, 7500, trajectory=trajectory)):
        scene = random_scene(config, 1)
        assert np.bincount(scene.camera_index, minlength=config.cameras).min() >= 4


def test_every_point_of_the_paper_is_seen_by_every_camera():
    scene = random_scene(scene_like("paper"), 5)
    assert len(np.unique(10 * scene.point_index + scene.camera_index)) == 100


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_the_cameras_hang_together(trajectory):
    scene = random_scene(middle(trajectory), 2)
    nodes = scene.num_cameras + scene.num_points
    links = coo_array(
        (
            np.ones(scene.num_observations),
            (scene.camera_index, scene.num_cameras + scene.point_index),
        ),
        (nodes, nodes),
    )
    assert connected_components(links, directed=False)[0] == 1


# Track lengths


@pytest.mark.parametrize("mean", [2.0, 2.01, 3.22, 4.1, 6.5, 20.0, 39.9, 40.0])
def test_track_lengths_add_up_within_their_bounds(mean):
    lengths = track_lengths(1000, round(1000 * mean), 40)
    assert lengths.sum() == round(1000 * mean)
    assert lengths.min() >= 2
    assert lengths.max() <= 40
    assert (np.diff(lengths) <= 0).all()


def test_the_histogram_is_the_power_law_with_cut_off():
    lengths = track_lengths(1_000_000, 4_400_000, 100)
    sizes, counts = np.unique(lengths[lengths <= 12], return_counts=True)
    corrected = np.log(counts) + 1.4 * np.log(sizes)  # a straight line with slope minus the cut-off
    slopes = np.diff(corrected)
    np.testing.assert_allclose(slopes, slopes.mean(), atol=5e-3)
    assert slopes.mean() < 0


@needs_data
@pytest.mark.parametrize(
    ("name", "file"),
    [("ladybug-49", "problem-49-7776-pre"), ("trafalgar-21", "problem-21-11315-pre")],
)
def test_track_lengths_are_spread_as_in_the_real_problem(name, file):
    from jaxba.io import read_problem

    real = read_problem(Path(str(DATA)) / "bal" / f"{file}.txt.bz2")
    scene = random_scene(scene_like(name), 0)
    expected, found = (np.bincount(problem.point_index) for problem in (real, scene))
    assert found.mean() == expected.mean()
    for low, high in ((2, 2), (3, 3), (4, 5), (6, 9), (10, 1000)):
        share = [np.mean((low <= lengths) & (lengths <= high)) for lengths in (expected, found)]
        assert share[1] == pytest.approx(share[0], abs=0.05)


@needs_data
def test_the_start_is_as_far_away_as_that_of_ladybug():
    from jaxba.io import read_problem

    real = read_problem(Path(str(DATA)) / "bal" / "problem-49-7776-pre.txt.bz2")
    assert 0.2 < cost(random_scene(scene_like("ladybug-49"), 0)) / cost(real) < 5


# Visibility


@pytest.mark.parametrize("trajectory", TRAJECTORIES)
def test_the_truth_is_in_front_of_its_cameras_and_inside_their_images(trajectory):
    config = middle(trajectory, noise=0.0, k1=(-0.05, 0.05), focal=(700.0, 900.0))
    truth = random_scene_with_truth(config, 3)[1]
    depth = depths(truth)
    assert depth.min() >= 0.5 * config.min_depth
    assert depth.max() <= 2 * config.max_depth
    assert (np.abs(truth.observations) <= [640.0, 480.0]).all()


def test_tracks_are_windows_of_the_path_with_gaps():
    scene = random_scene(middle("forward", gap_share=0.3), 4)
    tracks = np.split(scene.camera_index, np.flatnonzero(np.diff(scene.point_index)) + 1)
    stretch = np.array([(track[-1] - track[0] + 1) / len(track) for track in tracks])
    assert 1.0 <= np.median(stretch) < 1.6
    assert np.mean(stretch > 1) > 0.2
    tight = random_scene(middle("forward", gap_share=0.0), 4)
    tracks = np.split(tight.camera_index, np.flatnonzero(np.diff(tight.point_index)) + 1)
    assert np.mean([track[-1] - track[0] + 1 == len(track) for track in tracks]) > 0.8


def test_the_asked_share_of_tracks_closes_the_loop():
    config = SceneConfig(300, 6000, 24000, lap=120, revisit_share=0.2)
    scene = random_scene(config, 0)
    firsts = np.searchsorted(scene.point_index, np.arange(6000))
    lasts = np.append(firsts[1:], scene.num_observations) - 1
    spans = scene.camera_index[lasts] - scene.camera_index[firsts]
    assert np.mean(spans > 60) == pytest.approx(0.2, abs=0.05)
    none = random_scene(replace(config, revisit_share=0.0), 0)
    assert np.mean(none.camera_index[lasts] - none.camera_index[firsts] > 60) < 0.05


def test_the_street_comes_back_to_where_it_was():
    config = SceneConfig(250, 1000, 3000, lap=120, position_jitter=0.0, rotation_jitter=0.0)
    truth = random_scene_with_truth(config, 0)[1]
    centers = camera_centers(truth.cameras)
    np.testing.assert_allclose(centers[120:], centers[:-120], atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(np.diff(centers, axis=0), axis=1), 1.0, rtol=1e-9)


def test_photos_come_in_no_order_and_streets_in_the_order_of_the_path():
    gaps = {}
    for trajectory in ("forward", "photos"):
        truth = random_scene_with_truth(middle(trajectory), 0)[1]
        centers = camera_centers(truth.cameras)
        gaps[trajectory] = np.median(np.linalg.norm(np.diff(centers, axis=0), axis=1))
    assert gaps["forward"] == pytest.approx(1, abs=0.2)
    assert gaps["photos"] > 5


def test_the_unit_of_length_does_not_change_the_pixels():
    for trajectory in TRAJECTORIES:
        small, large = (random_scene(middle(trajectory, step=step), 9) for step in (1.0, 8.0))
        np.testing.assert_array_equal(small.camera_index, large.camera_index)
        np.testing.assert_allclose(small.observations, large.observations, atol=1e-6)
        np.testing.assert_allclose(8 * small.points, large.points, rtol=1e-9, atol=1e-6)


# Noise and start


def test_the_same_seed_gives_the_same_scene_and_another_seed_another():
    for trajectory in TRAJECTORIES:
        first, again, other = (random_scene(middle(trajectory), seed) for seed in (7, 7, 8))
        for field in fields(BundleProblem)[:-1]:
            np.testing.assert_array_equal(getattr(first, field.name), getattr(again, field.name))
        assert (first.points != other.points).any()
    generated = random_scene(MIDDLE, np.random.default_rng(7))
    np.testing.assert_array_equal(generated.points, random_scene(MIDDLE, 7).points)


@pytest.mark.parametrize("noise", [0.0, 0.5, 2.0])
def test_the_truth_has_residuals_of_the_asked_noise(noise):
    truth = random_scene_with_truth(middle("forward", noise=noise), 1)[1]
    values = residuals(truth).ravel()
    assert values.mean() == pytest.approx(0, abs=5 * noise / np.sqrt(values.size))
    assert values.std() == pytest.approx(noise, rel=5 / np.sqrt(2 * values.size))
    # Half the squared noise times chi-square of 2N degrees of freedom: mean noise^2 N, sigma
    # noise^2 sqrt(N).
    count = truth.num_observations
    assert cost(truth) == pytest.approx(noise**2 * count, abs=5 * noise**2 * np.sqrt(count))


def test_the_asked_share_of_observations_are_wrong_matches():
    config = middle("orbit", noise=0.0, outlier_share=0.1, outlier_size=20.0)
    values = residuals(random_scene_with_truth(config, 1)[1])
    wrong = np.abs(values).max(axis=1) > 1e-9
    assert wrong.mean() == pytest.approx(0.1, abs=0.02)
    assert np.abs(values).max() <= 20
    assert values[wrong].std() == pytest.approx(20 / np.sqrt(3), rel=0.1)


def test_without_start_noise_the_start_is_the_truth():
    still = {field.name: 0.0 for field in fields(SceneConfig) if field.name.startswith("start_")}
    start, truth = random_scene_with_truth(middle("photos", **still), 1)
    np.testing.assert_allclose(project(start), project(truth), atol=1e-6)
    np.testing.assert_allclose(start.points, truth.points, atol=1e-9)


@pytest.mark.parametrize(
    "knob", ["start_rotation", "start_center", "start_point", "start_focal", "start_drift"]
)
def test_each_knob_of_the_start_moves_it_further_away(knob):
    still = {field.name: 0.0 for field in fields(SceneConfig) if field.name.startswith("start_")}
    quiet = middle("forward", **still)
    costs = [cost(random_scene(replace(quiet, **{knob: value}), 2)) for value in (0.0, 1e-3, 1e-2)]
    assert costs[0] < costs[1] < costs[2]


@pytest.mark.parametrize(
    "name", [*SMALL_NAMES, pytest.param("dubrovnik-356", marks=pytest.mark.slow)]
)
def test_the_start_is_as_far_as_bal_starts_are(name):
    start, truth = random_scene_with_truth(scene_like(name), 0)
    assert 10 < cost(start) / cost(truth) < 200
    assert np.mean(depths(start) <= 0) < 0.002


def test_drift_bends_the_path_but_hardly_the_neighbourhood():
    still = {field.name: 0.0 for field in fields(SceneConfig) if field.name.startswith("start_")}
    config = middle("forward", **{**still, "start_drift": 0.01})
    start, truth = random_scene_with_truth(config, 3)
    moved = np.linalg.norm(camera_centers(start.cameras) - camera_centers(truth.cameras), axis=1)
    assert moved[0] == pytest.approx(0, abs=1e-9)
    assert moved[-1] > 5 * moved[5]
    steps = np.linalg.norm(np.diff(camera_centers(start.cameras), axis=0), axis=1)
    np.testing.assert_allclose(
        steps, np.linalg.norm(np.diff(camera_centers(truth.cameras), axis=0), axis=1), rtol=1e-9
    )


@pytest.mark.parametrize("name", ["tiny", "paper"])
def test_a_solved_scene_ends_at_the_noise_floor(name):
    config = scene_like(name)
    freedom = 2 * config.total - (9 * config.cameras + 3 * config.points - 7)
    ratios = []
    for seed in range(2):
        start, truth = random_scene_with_truth(config, seed)
        end = solve(start)
        assert end <= cost(truth)
        ratios.append(end / (0.5 * config.noise**2 * freedom))
    sigma = np.sqrt(2 / (freedom * len(ratios)))
    assert np.mean(ratios) == pytest.approx(1, abs=4 * sigma)


def solve(problem: BundleProblem) -> float:
    """Cost after SciPy's Levenberg-Marquardt with forward differences."""
    split = problem.cameras.size

    def function(x: np.ndarray) -> np.ndarray:
        moved = problem.replace(cameras=x[:split].reshape(-1, 9), points=x[split:].reshape(-1, 3))
        return residuals(moved).ravel()

    x = np.concatenate([problem.cameras.ravel(), problem.points.ravel()])
    return float(
        least_squares(function, x, method="trf", x_scale="jac", ftol=1e-5, max_nfev=30).cost
    )


# Refusals


def test_an_unknown_name_lists_the_known_ones():
    with pytest.raises(ProblemError, match=r"ladybug-49.*final-13682"):
        scene_like("ladybug")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"cameras": 1}, "2 cameras"),
        ({"points": 0}, "a point"),
        ({"observations": 2999}, "3000 to 90000"),
        ({"observations": 90001}, "3000 to 90000"),
        ({"step": 0.0}, "step"),
        ({"noise": -1.0}, "noise"),
        ({"noise": float("nan")}, "noise is not finite"),
        ({"gap_share": 1.5}, "gap_share"),
        ({"min_depth": 200.0}, "depth"),
        ({"focal": (900.0, 800.0)}, "focal"),
        ({"focal": (0.0, 800.0)}, "focal"),
        ({"k1": (-1.0, 0.0)}, "fold"),
        ({"observations": 0, "mean_track": float("nan")}, "mean_track is not finite"),
        ({"observations": 0, "mean_track": 1.9}, "3000 to 90000"),
    ],
)
def test_options_that_make_no_sense_are_refused(change, message):
    with pytest.raises(ProblemError, match=message):
        random_scene(replace(MIDDLE, **change), 0)


def test_an_unknown_trajectory_is_refused():
    config = replace(MIDDLE)
    object.__setattr__(config, "trajectory", "spiral")  # past the type check that tests run with
    with pytest.raises(ProblemError, match="trajectory must be"):
        random_scene(config, 0)


def test_more_views_than_the_cameras_overlap_are_refused():
    with pytest.raises(ProblemError, match="overlap too little"):
        random_scene(SceneConfig(300, 30, 9000), 0)
