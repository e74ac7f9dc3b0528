"""A scene is aligned with measured positions as far as these determine it, and positions that
cannot be are refused."""

from __future__ import annotations

import numpy as np
import pytest
import support
from scipy.spatial.transform import Rotation

from jaxba import BundleProblem, ProblemError, ProblemWarning, with_position_priors
from jaxba.problem import geometry
from jaxba.problem.similarity import along_line

COUNT = 12
TURN = Rotation.from_rotvec([0.4, -0.3, 1.2])
EARTH = 6.371e6

ON_A_LINE = "the positions lie on a line within their noise"
AT_ONE_PLACE = "the positions are at one place within their noise"


def at_places(centers: np.ndarray) -> BundleProblem:
    """The cameras of a scene, turned as they were, at other places."""
    problem = support.paper(0)
    cameras = np.array(problem.cameras[np.arange(len(centers)) % problem.num_cameras])
    cameras[:, 3:6] = geometry.translations(geometry.rotation_matrices(cameras[:, :3]), centers)
    return BundleProblem.create(
        cameras, problem.points, problem.observations, problem.camera_index, problem.point_index
    )


def flight(
    seed: int, noise: float, across: float = 0.0, own: float = 0.01
) -> tuple[BundleProblem, np.ndarray]:
    """A scene on a line along x with errors of its own, and positions of it in the same frame with
    noise."""
    rng = np.random.default_rng(seed)
    true = np.c_[15.0 * np.arange(COUNT), across * rng.uniform(-1, 1, COUNT), np.full(COUNT, 80.0)]
    scene = true + own * rng.normal(size=true.shape)
    return at_places(scene), true + noise * rng.normal(size=true.shape)


def turn_of(before: BundleProblem, after: BundleProblem) -> np.ndarray:
    """By what the cameras were turned in the scene, angle-axis."""
    first, second = (Rotation.from_rotvec(p.cameras[:, :3]) for p in (before, after))
    return (second.inv() * first).as_rotvec().mean(axis=0)


def block() -> tuple[BundleProblem, np.ndarray]:
    """A scene in its own frame, and the exact positions of its cameras in metres, in another."""
    centers = np.random.default_rng(5).uniform(0, 1, (COUNT, 3)) * [10, 8, 2]
    return at_places(centers), TURN.apply(30 * centers)


@pytest.mark.parametrize("noise", [0.0, 1e-9, 0.02])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_straight_flight_keeps_the_roll_of_the_scene(seed, noise):
    problem, positions = flight(seed, noise)
    with pytest.warns(ProblemWarning, match=ON_A_LINE):
        found = with_position_priors(problem, positions, stddev=0.02)
    turned = turn_of(problem, found)
    assert np.abs(turned).max() < 1e-3, "noise of 2 cm on 165 m"
    assert np.linalg.norm(geometry.camera_centers(found.cameras) - positions, axis=1).max() < 0.15


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_flight_that_leaves_its_line_by_less_than_the_errors_of_the_scene_keeps_its_roll(seed):
    problem, positions = flight(seed, 0.02, across=0.2, own=0.5)
    with pytest.warns(ProblemWarning) as notes:
        found = with_position_priors(problem, positions, stddev=0.02)
    assert any(ON_A_LINE in str(note.message) for note in notes)
    assert np.abs(turn_of(problem, found)).max() < 0.02, "errors of 0.5 m on 165 m"


def test_a_flight_with_a_second_strip_determines_the_roll():
    problem, positions = flight(0, 0.02, across=5.0)
    found = with_position_priors(
        problem, Rotation.from_rotvec([1.0, 0, 0]).apply(positions), stddev=0.02
    )
    np.testing.assert_allclose(turn_of(problem, found), [1.0, 0, 0], atol=0.01)


def test_a_line_is_mapped_to_a_line_by_the_smallest_rotation():
    rng = np.random.default_rng(1)
    for angle in (0.0, 1e-9, 0.7, np.pi - 1e-3, np.pi - 1e-5, np.pi - 1e-9, np.pi):
        axis = np.cross([1.0, 2.0, 0.5], rng.normal(size=3))
        turn = Rotation.from_rotvec(angle * axis / np.linalg.norm(axis))
        source = np.array([1.0, 2.0, 3.0]) + np.outer(rng.normal(size=6), [1.0, 2.0, 0.5])
        target = turn.apply(3.0 * source) + 5
        found = along_line(source, target, np.ones(6))
        np.testing.assert_allclose(found.points(source), target, atol=1e-9)
        rotation = Rotation.from_matrix(found.rotation)
        np.testing.assert_allclose(
            [rotation.magnitude(), np.linalg.det(found.rotation)], [angle, 1], atol=1e-7
        )


@pytest.mark.parametrize(("images", "scale"), [([3], 1.0), ([0, 1, 2, 3], 1.0), ([0, 5], 30.0)])
def test_few_positions_or_ones_within_their_noise_say_what_they_can(images, scale):
    problem, positions = block()
    close = images == [0, 1, 2, 3]
    with pytest.warns(ProblemWarning, match=ON_A_LINE if scale > 1 else AT_ONE_PLACE):
        found = with_position_priors(
            problem, positions[images], stddev=1e3 if close else 1.0, images=images
        )
    before, after = (geometry.camera_centers(p.cameras)[images] for p in (problem, found))
    np.testing.assert_allclose(after.mean(axis=0), positions[images].mean(axis=0), atol=1e-8)
    np.testing.assert_allclose(
        after.std(axis=0).max() / max(before.std(axis=0).max(), 1e-9) > 5, scale > 1
    )
    if scale == 1.0:
        np.testing.assert_allclose(found.cameras[:, :3], problem.cameras[:, :3], atol=1e-12)


def degrees(metres: np.ndarray, latitude: float) -> np.ndarray:
    north = metres[:, 1] / EARTH
    east = metres[:, 0] / EARTH / np.cos(np.radians(latitude))
    return np.c_[latitude + np.degrees(north), 8.0 + np.degrees(east), 500 + metres[:, 2]]


@pytest.mark.parametrize("stddev", [1e-6, 0.02, 2.0])
@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: degrees(p, 47.0), "latitude and longitude in degrees: give metres"),
        (
            lambda p: degrees(p, -33.0)[:, [1, 0, 2]],
            "latitude and longitude in degrees: give metres",
        ),
        (lambda p: p[:, [1, 0, 2]], "mirrored: are two axes swapped, or is one reversed"),
        (lambda p: p * [1, 1, -1], "mirrored: are two axes swapped, or is one reversed"),
    ],
)
def test_degrees_and_mirrored_axes_are_refused_whatever_the_standard_deviations(
    change, message, stddev
):
    problem, positions = block()
    wrong = change(positions)
    with pytest.raises(ProblemError, match=message):
        with_position_priors(problem, wrong, stddev=stddev)
    kept = with_position_priors(problem, wrong, stddev=stddev, align=False)
    assert (kept.residuals.rows[0].data[0] == wrong).all()


def test_positions_that_do_not_fit_are_noted_and_those_that_do_are_not():
    problem, positions = block()
    rng = np.random.default_rng(3)
    with pytest.warns(
        ProblemWarning,
        match=r"a quarter of the images .* times what the standard deviations explain",
    ):
        with_position_priors(problem, positions * [1, 1, 3], stddev=0.5)
    some = positions + 0.5 * rng.normal(size=positions.shape)
    with_position_priors(problem, some, stddev=0.5)


def test_wrong_positions_are_named_and_do_not_move_the_scene():
    problem, positions = block()
    some = positions + 0.5 * np.random.default_rng(3).normal(size=positions.shape)
    some[[4, 7]] += [500.0, -300.0, 0.0]
    with pytest.warns(
        ProblemWarning, match=r"the others: camera [47] is 58\d .*, camera [47] is 58\d .*\)$"
    ):
        found = with_position_priors(problem, some, stddev=0.5)
    away = np.linalg.norm(geometry.camera_centers(found.cameras) - positions, axis=1)
    assert away.max() < 1.5


def test_four_positions_with_an_axis_mirrored_are_refused():
    problem, positions = block()
    with pytest.raises(ProblemError, match="mirrored: are two axes swapped"):
        with_position_priors(problem, positions[:4] * [1, 1, -1], stddev=0.02, images=range(4))


def test_exact_images_count_more_than_rough_ones():
    problem, positions = block()
    rough = np.arange(COUNT) % 2 == 1
    noisy = positions + np.where(rough[:, None], 5.0, 0.01) * np.random.default_rng(0).normal(
        size=positions.shape
    )
    found = with_position_priors(problem, noisy, stddev=np.where(rough, 5.0, 0.01))
    away = np.linalg.norm(geometry.camera_centers(found.cameras) - positions, axis=1)
    assert away.max() < 0.05
