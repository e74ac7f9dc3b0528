"""Trajectory errors against hand-made cases, SciPy, and the development kit's program retold with 4
x 4 matrices."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxba.kitti.evaluate import (
    DEVKIT_LENGTHS,
    absolute_errors,
    path_length,
    relative_errors,
    segment_errors,
)
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.similarity import umeyama


def wander(count: int, seed: int, step: float = 1.0) -> np.ndarray:
    """A random walk of poses."""
    random = np.random.default_rng(seed)
    rotation = Rotation.from_rotvec(
        np.cumsum(0.05 * random.standard_normal((count, 3)), axis=0)
    ).as_matrix()
    centers = np.cumsum(
        step * (rotation[:, :, 2] + 0.1 * random.standard_normal((count, 3))), axis=0
    )
    return np.concatenate([rotation, centers[:, :, None]], axis=2)


def noisy(poses: np.ndarray, seed: int, sigma: float) -> np.ndarray:
    random = np.random.default_rng(seed)
    turn = Rotation.from_rotvec(sigma * random.standard_normal((len(poses), 3))).as_matrix()
    centers = poses[:, :, 3:] + sigma * random.standard_normal((len(poses), 3, 1))
    return np.concatenate([turn @ poses[:, :, :3], centers], axis=2)


def moved(poses: np.ndarray, scale: float, turn: np.ndarray, shift: np.ndarray) -> np.ndarray:
    """Poses in another world: scaled, turned and shifted."""
    centers = scale * poses[:, :, 3] @ turn.T + shift
    return np.concatenate([turn @ poses[:, :, :3], centers[:, :, None]], axis=2)


def align(estimate: np.ndarray, truth: np.ndarray) -> np.ndarray:
    return umeyama(estimate[:, :, 3], truth[:, :, 3]).poses(estimate)


TURN = Rotation.from_rotvec([0.4, -1.1, 2.0]).as_matrix()
SHIFT = np.array([10.0, -3.0, 200.0])


def test_a_known_similarity_is_found_again():
    truth = wander(30, 0)
    found = umeyama(truth[:, :, 3], 3.5 * truth[:, :, 3] @ TURN.T + SHIFT)
    assert found.scale == pytest.approx(3.5, rel=1e-12)
    np.testing.assert_allclose(found.rotation, TURN, atol=1e-12)
    np.testing.assert_allclose(found.translation, SHIFT, atol=1e-10)


def test_a_trajectory_in_another_world_has_no_error():
    truth = wander(150, 1)
    aligned = align(moved(truth, 0.02, TURN, SHIFT), truth)
    np.testing.assert_allclose(aligned, truth, atol=1e-10)
    assert absolute_errors(aligned, truth).rmse < 1e-10
    assert max(errors.largest for errors in relative_errors(aligned, truth)) < 1e-10
    segments = segment_errors(aligned, truth)
    assert segments is not None
    assert segments.translation < 1e-10
    assert segments.rotation < 1e-10


def test_the_alignment_minimises_the_rmse_over_all_similarities():
    """The same minimum by SciPy's general optimiser over seven numbers."""
    truth = wander(20, 2)
    estimate = noisy(moved(truth, 0.3, TURN, SHIFT), 3, 0.3)

    def mean_square(x):
        centers = (
            np.exp(x[0]) * estimate[:, :, 3] @ Rotation.from_rotvec(x[1:4]).as_matrix().T + x[4:]
        )
        return ((centers - truth[:, :, 3]) ** 2).sum(axis=1).mean()

    start = np.concatenate(
        [[-np.log(0.3)], Rotation.from_matrix(TURN.T).as_rotvec(), -SHIFT @ TURN / 0.3]
    )
    best = minimize(mean_square, start, method="BFGS", options={"gtol": 1e-9})
    found = absolute_errors(align(estimate, truth), truth).rmse
    assert found <= np.sqrt(best.fun) * (1 + 1e-12)
    # as far as BFGS comes, by differences
    assert found == pytest.approx(np.sqrt(best.fun), rel=1e-4)


def test_the_rotation_is_that_of_scipys_wahba_solution():
    source = wander(12, 4)[:, :, 3]
    target = wander(12, 5)[:, :, 3]
    a = source - source.mean(axis=0)
    b = target - target.mean(axis=0)
    turn, _ = Rotation.align_vectors(b, a)
    np.testing.assert_allclose(umeyama(source, target).rotation, turn.as_matrix(), atol=1e-9)


def test_a_mirror_image_is_aligned_by_a_rotation():
    truth = wander(20, 6)
    found = umeyama(truth[:, :, 3] * [1, -1, 1], truth[:, :, 3])
    assert np.linalg.det(found.rotation) == pytest.approx(1)


def test_errors_of_a_square_with_a_raised_corner():
    """Corners of a unit square around the origin, one raised by h, without alignment: rmse h / 2,
    the largest h."""
    square = np.zeros((4, 3, 4))
    square[:, :, :3] = np.eye(3)
    square[:, :2, 3] = [[1, 1], [-1, 1], [-1, -1], [1, -1]]
    raised = square.copy()
    raised[2, 2, 3] = 0.6
    errors = absolute_errors(raised, square)
    assert errors == pytest.approx((0.3, 0.15, 0.0, 0.6))
    translation, rotation = relative_errors(raised, square)  # into the corner and out of it
    assert translation == pytest.approx((np.sqrt(0.24), 0.4, 0.6, 0.6))
    assert rotation == pytest.approx((0, 0, 0, 0))


def test_a_turn_of_known_angle_is_the_relative_rotation_error():
    truth = wander(3, 7)
    estimate = truth.copy()
    estimate[2, :, :3] = truth[2, :, :3] @ Rotation.from_rotvec(np.deg2rad([0, 3, 0])).as_matrix()
    errors = relative_errors(estimate, truth)[1]
    assert errors == pytest.approx((3 / np.sqrt(2), 1.5, 1.5, 3))


def test_tiny_and_straight_angles_keep_their_digits():
    truth = wander(2, 8)
    for angle in (1e-7, 179.9999):
        estimate = truth.copy()
        estimate[1, :, :3] = (
            truth[1, :, :3] @ Rotation.from_rotvec(np.deg2rad([angle, 0, 0])).as_matrix()
        )
        assert relative_errors(estimate, truth)[1].largest == pytest.approx(angle, rel=1e-6)


def test_relative_errors_do_not_depend_on_where_the_estimate_stands():
    truth = wander(40, 9)
    estimate = noisy(truth, 10, 0.05)
    there = moved(estimate, 1.0, TURN, SHIFT)
    for a, b in zip(relative_errors(estimate, truth), relative_errors(there, truth), strict=True):
        assert a == pytest.approx(b, rel=1e-9)
    assert segment_errors(estimate, truth, (10.0,)) == pytest.approx(
        segment_errors(there, truth, (10.0,)), rel=1e-9
    )


def test_a_path_that_is_five_percent_too_long_has_segment_errors_of_five_percent():
    truth = np.zeros((300, 3, 4))
    truth[:, :, :3] = np.eye(3)
    truth[:, 2, 3] = np.arange(300.0)
    estimate = truth.copy()
    estimate[:, 2, 3] *= 1.05
    found = segment_errors(estimate, truth)
    assert found is not None
    # a segment ends one metre past its length: the first pose that is *more* than 100 m on
    assert found.segments == len(range(0, 199, 10)) + len(range(0, 99, 10))
    expected = [5 * 1.01] * 20 + [5 * 201 / 200] * 10
    assert found.translation == pytest.approx(np.mean(expected))
    assert found.rotation == pytest.approx(0, abs=1e-12)


def devkit(estimate: np.ndarray, truth: np.ndarray, lengths) -> tuple[float, float, int]:
    """`calcSequenceErrors` of the development kit, line by line."""

    def square(poses):
        return [np.vstack([pose, [0, 0, 0, 1]]) for pose in poses]

    gt = square(truth)
    result = square(estimate)
    dist = [0.0]
    for i in range(1, len(gt)):
        dist.append(dist[-1] + np.sqrt(sum((gt[i][k, 3] - gt[i - 1][k, 3]) ** 2 for k in range(3))))
    t_err = []
    r_err = []
    for first_frame in range(0, len(gt), 10):
        for length in lengths:
            last_frame = next(
                (i for i in range(first_frame, len(dist)) if dist[i] > dist[first_frame] + length),
                -1,
            )
            if last_frame == -1:
                continue
            pose_delta_gt = np.linalg.inv(gt[first_frame]) @ gt[last_frame]
            pose_delta_result = np.linalg.inv(result[first_frame]) @ result[last_frame]
            error = np.linalg.inv(pose_delta_result) @ pose_delta_gt
            d = 0.5 * (error[0, 0] + error[1, 1] + error[2, 2] - 1.0)
            r_err.append(np.arccos(max(min(d, 1.0), -1.0)) / length)
            t_err.append(np.sqrt((error[:3, 3] ** 2).sum()) / length)
    return 100 * float(np.mean(t_err)), float(np.rad2deg(np.mean(r_err))), len(t_err)


def test_segment_errors_are_those_of_the_development_kit():
    truth = wander(400, 11)
    estimate = noisy(truth, 12, 0.1)
    for lengths in (DEVKIT_LENGTHS, (5.0, 17.0)):
        found = segment_errors(estimate, truth, lengths)
        assert found is not None
        assert tuple(found) == pytest.approx(devkit(estimate, truth, lengths), rel=1e-8)


def test_a_short_path_has_no_segment_errors():
    truth = wander(50, 13)
    assert segment_errors(truth, truth) is None


@pytest.mark.parametrize("count", [2, 10])
def test_too_few_poses_or_a_straight_line_cannot_be_aligned(count):
    line = np.zeros((count, 3))
    line[:, 2] = np.arange(count)
    with pytest.raises(ProblemError, match=r"needs 3 poses|straight line"):
        umeyama(line, line)


@pytest.mark.parametrize("place", [1e200, 1e100])
def test_poses_too_far_away_to_be_squared_cannot_be_aligned(place):
    poses = wander(10, 0)
    far = poses.copy()
    far[3, :, 3] = place
    with pytest.raises(ProblemError, match="cannot be aligned"):
        align(far, poses)


def test_poses_that_all_stand_in_one_place_cannot_be_aligned():
    with pytest.raises(ProblemError, match="cannot be aligned"):
        umeyama(np.ones((5, 3)), wander(5, 14)[:, :, 3])


def test_path_length_of_a_square():
    corners = np.zeros((5, 3, 4))
    corners[:, :2, 3] = [[0, 0], [2, 0], [2, 2], [0, 2], [0, 0]]
    assert path_length(corners) == pytest.approx(8)
