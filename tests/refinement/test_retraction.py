"""How a step is added to the cameras: the same to first order in all coordinates, and along a zoom
exact."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from scipy.spatial.transform import Rotation
from support import same_bits, solve

from jaxba import BundleProblem, StepOptions, build_layout
from jaxba.problem.intrinsics import Lenses
from jaxba.problem.options import Coordinates
from jaxba.refinement.retraction import MAX_FOCAL_CHANGE, move_cameras, step_between

PIXELS = StepOptions(coordinates=Coordinates(lens_step="pixels"))
FILE = StepOptions()

_move = jax.jit(move_cameras, static_argnames=("options",))


def random_step(seed: int, size: float) -> tuple[np.ndarray, np.ndarray]:
    """Cameras of `tiny` with distortion, and a step, both as [9, cameras]; focal lengths change by
    `size` at most."""
    rng = np.random.default_rng(seed)
    cameras = np.array(support.tiny().cameras).T
    cameras[7:] = rng.normal(size=cameras[7:].shape) * [[0.1], [0.05]]
    step = size * rng.uniform(-1, 1, size=cameras.shape)
    step[6] *= cameras[6]
    return cameras, step


@pytest.mark.parametrize("rotation", ["angle-axis", "manifold"])
def test_all_lens_steps_agree_to_first_order(rotation):
    cameras, step = random_step(0, 1.0)
    layout = build_layout(support.tiny())
    first = []
    for lens_step in ("file", "pixels"):
        options = StepOptions(coordinates=Coordinates(rotation=rotation, lens_step=lens_step))

        def along(size, options=options):
            return move_cameras(layout, jnp.asarray(cameras), size * step, options)

        first.append(jax.jvp(along, (0.0,), (1.0,)))
    (start, slope), (other_start, other_slope) = first
    np.testing.assert_allclose(other_slope, slope, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(other_start, start, atol=0)
    far, other_far = (
        _move(layout, cameras, 0.2 * step, StepOptions(coordinates=Coordinates(lens_step=how)))
        for how in ("file", "pixels")
    )
    assert np.abs(other_far[7:] - far[7:]).max() > 1e-3  # and not to second


@pytest.mark.parametrize("rotation", ["angle-axis", "manifold"])
@pytest.mark.parametrize("lens_step", ["file", "pixels"])
def test_the_step_between_two_places_is_the_one_that_was_made_to_first_order(rotation, lens_step):
    cameras, step = random_step(3, 1e-5)
    # turned by a radian or two
    cameras[:3] = np.random.default_rng(4).normal(size=cameras[:3].shape)
    options = StepOptions(coordinates=Coordinates(rotation=rotation, lens_step=lens_step))
    moved = _move(build_layout(support.tiny()), cameras, step, options)
    found = step_between(jnp.asarray(cameras), moved, options)
    np.testing.assert_allclose(found, step, rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize("growth", [0.25, -0.25])
def test_a_zoom_along_which_the_image_stays_changes_no_pixel(growth):
    """Focal length and all depths grow alike; the first-order change of k1 and k2 is what a linear
    model proposes."""
    rng = np.random.default_rng(1)
    local = np.column_stack([rng.normal(size=(20, 2)), -rng.uniform(2, 9, size=20)])
    turn = Rotation.from_rotvec([0.3, -0.2, 0.9])
    camera = np.array([*turn.as_rotvec(), 0.1, 0.2, 0.3, 500.0, 0.15, -0.08])

    def seen(camera, local):
        return support.distort(-local[:, :2] / local[:, 2:], np.tile(camera[6:], (20, 1)))

    step = np.zeros((9, 1))
    step[6:, 0] = camera[6] * growth, 2 * camera[7] * growth, 4 * camera[8] * growth
    points = turn.inv().apply(local - camera[3:6])
    problem = BundleProblem(
        cameras=camera[None],
        points=points,
        observations=seen(camera, local),
        camera_index=np.zeros(20, int),
        point_index=np.arange(20),
    )
    after = {
        how: np.asarray(
            _move(
                build_layout(problem),
                camera[:, None],
                step,
                StepOptions(coordinates=Coordinates(lens_step=how)),
            )
        )[:, 0]
        for how in ("file", "pixels")
    }
    stretched = local * [1, 1, 1 + growth]
    np.testing.assert_allclose(seen(after["pixels"], stretched), seen(camera, local), rtol=1e-12)
    assert np.abs(seen(after["file"], stretched) - seen(camera, local)).max() > 0.1


def test_far_from_where_it_is_linear_a_lens_is_added_as_it_is():
    cameras, step = random_step(2, 0.1)
    near = 0.9 * MAX_FOCAL_CHANGE
    far = 1.1 * MAX_FOCAL_CHANGE
    step[6] = cameras[6] * np.array([near, -near, far, -far, 50.0, -2.0])
    moved, plain = (
        np.asarray(_move(build_layout(support.tiny()), cameras, step, how))
        for how in (PIXELS, FILE)
    )
    assert (moved[7:, :2] != plain[7:, :2]).all()
    chex.assert_trees_all_equal(moved[:, 2:], plain[:, 2:], strict=True)
    chex.assert_trees_all_equal(moved[:7], plain[:7], strict=True)


def test_a_camera_without_focal_length_stays_finite():
    cameras, step = random_step(3, 0.1)
    cameras[6, 0] = 0
    moved, plain = (
        np.asarray(_move(build_layout(support.tiny()), cameras, step, how))
        for how in (PIXELS, FILE)
    )
    assert np.isfinite(moved).all()
    chex.assert_trees_all_equal(moved[:, 0], plain[:, 0], strict=True)


def test_what_of_a_lens_stays_is_not_touched_by_a_zoom():
    problem = support.tiny()
    (cameras, step) = random_step(4, 0.1)
    held = np.array([[True, False, True], [True, True, False], [True, False, False]])
    lenses = Lenses(np.arange(problem.num_cameras) % 3, held)
    step[7, [0, 2, 3, 5]] = 0  # as the linear model has it
    step[8, [1, 2, 4, 5]] = 0
    layout = build_layout(problem.replace(cameras=cameras.T, lenses=lenses))
    moved = np.asarray(_move(layout, cameras, step, PIXELS))
    for row, column in ((7, 1), (8, 2)):
        free = held[lenses.index, column]
        chex.assert_trees_all_equal(moved[row, ~free], cameras[row, ~free], strict=True)
        assert (moved[row, free] != (cameras + step)[row, free]).all()
    fixed = StepOptions(intrinsics="fixed", coordinates=Coordinates(lens_step="pixels"))
    step[6:] = 0
    chex.assert_trees_all_equal(
        np.asarray(_move(layout, cameras, step, fixed))[6:], cameras[6:], strict=True
    )


@pytest.mark.slow
def test_shared_lenses_stay_equal_bit_by_bit():
    problem = support.tiny()
    cameras = np.array(problem.cameras)
    cameras[:, 6:] = cameras[0, 6], 0.05, -0.01
    lenses = Lenses(np.zeros(problem.num_cameras, int), np.ones((1, 3), bool))
    found = solve(
        problem.replace(cameras=cameras, lenses=lenses), "ceres", PIXELS, max_iterations=8
    )
    lens = np.asarray(found.problem.cameras)[:, 6:]
    assert same_bits(lens, np.tile(lens[:1], (len(lens), 1)))
    assert (lens[0] != cameras[0, 6:]).all()


@pytest.mark.slow
def test_without_a_change_of_focal_length_nothing_differs():
    cameras, step = random_step(5, 0.1)
    step[6] = 0
    layout = build_layout(support.tiny())
    chex.assert_trees_all_equal(
        _move(layout, cameras, step, PIXELS), _move(layout, cameras, step, FILE), strict=True
    )
