"""Embedded iterations: cameras alone, shorter trials, repairs; against SciPy, dense algebra and
plain evaluation."""

from __future__ import annotations

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares
from support import solve, start, step

from jaxba import BundleProblem, Layout, LMState, StepOptions, lm_step, make_policy
from jaxba.game.random_scenes import SceneClass, make_scenes
from jaxba.game.scene_bank import initial_costs
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.linear.cholesky import solve_positive
from jaxba.lm.damped_step import solve_step
from jaxba.model.linearize import cost, linearize
from jaxba.problem import geometry
from jaxba.problem.options import Coordinates, Refinement
from jaxba.refinement import candidates
from jaxba.refinement.acceptance import NEGLIGIBLE, comparison
from jaxba.refinement.cameras import DAMPINGS, refine_cameras
from jaxba.refinement.candidates import (
    GAIN_TOLERANCE,
    GOOD_GAIN,
    MAX_COST_RATIO,
    MIN_GAINS,
    ROUNDS_OF_LATER_CANDIDATES,
    SHORTER,
    SMALL_DAMPING_FRACTION,
    best_candidate,
)

pytestmark = pytest.mark.step

PLAIN = StepOptions()
SHORTER_ONLY = StepOptions(refinement=Refinement(trials=4))
EVERYTHING = StepOptions(
    refinement=Refinement(points=3, trials=4, camera_rounds=3, pattern_moves=4)
)
MOVES_ONLY = StepOptions(refinement=Refinement(pattern_moves=4))

BOLD = 1e-8
"""A lambda that leaves far starts to Gauss-Newton."""

_refine = jax.jit(refine_cameras, static_argnames=("options",))


def turned(seed: int, size: float) -> BundleProblem:
    """`tiny` with cameras off in proportion to `size`; the shape stays, so the program does too."""
    problem = support.tiny()
    rng = np.random.default_rng(seed)
    cameras = np.array(problem.cameras)
    cameras[:, :3] += 0.05 * size * rng.normal(size=(len(cameras), 3))
    cameras[:, 3:6] += 0.2 * size * rng.normal(size=(len(cameras), 3))
    cameras[:, 6] *= 1 + 0.1 * size * rng.normal(size=len(cameras))
    return problem.replace(cameras=cameras)


def far(seed: int) -> BundleProblem:
    """`turned`, with points far from where they belong as well."""
    problem = turned(seed, 1.0)
    return problem.replace(
        points=problem.points + np.random.default_rng(100 + seed).normal(size=problem.points.shape)
    )


def camera_costs(problem: BundleProblem) -> np.ndarray:
    """Cost of each camera's observations, by NumPy."""
    squared = np.sum(geometry.residuals(problem) ** 2, axis=1)
    return np.bincount(problem.camera_index, 0.5 * squared, minlength=problem.num_cameras)


def resected(problem: BundleProblem, times: int = 1) -> BundleProblem:
    """The problem after rounds of every camera alone."""
    layout, before = start(problem)
    cameras = before.cameras
    for _ in range(times):
        cameras = _refine(layout, cameras, before.points, PLAIN)
    return support.back(problem, before, before._replace(cameras=cameras))


# Cameras alone


@settings(max_examples=30, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(-6, 6))
def test_small_systems_are_solved_as_lapack_solves_them(seed, decades):
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(7, 9, 12))
    scale = 10.0 ** rng.uniform(-abs(decades), abs(decades), size=(7, 9, 1))
    matrix = (scale * root) @ (scale * root).transpose(0, 2, 1)
    right = scale[:, :, 0] * rng.normal(size=(7, 9))
    found = np.asarray(solve_positive(jnp.asarray(matrix), jnp.asarray(right)))
    expected = np.linalg.solve(matrix, right[:, :, None])[:, :, 0]
    # in the units of the scale, where the systems are well conditioned
    np.testing.assert_allclose(
        found * scale[:, :, 0], expected * scale[:, :, 0], rtol=1e-7, atol=1e-9
    )


@pytest.mark.parametrize(("seed", "size"), [(0, 0.0), (1, 0.1), (2, 1.0), (3, 3.0), (4, 20.0)])
def test_no_camera_gets_worse_and_points_are_not_touched(seed, size):
    problem = turned(seed, size)
    after = resected(problem)
    assert (camera_costs(after) <= camera_costs(problem)).all()
    assert np.array_equal(after.points, problem.points)


def test_a_round_is_a_damped_gauss_newton_step_of_each_camera():
    """On the manifold, by the Jacobian of support.py; where the first damping does not help, the
    second."""
    manifold = StepOptions(coordinates=Coordinates(rotation="manifold"))
    helped = 0
    for seed, size in ((1, 0.1), (2, 0.5), (5, 2.0)):
        problem = turned(seed, size)
        after = resected(problem)
        residual, jacobian = support.linear(problem, manifold)
        before = camera_costs(problem)
        for camera in range(problem.num_cameras):
            own = slice(9 * camera, 9 * camera + 9)
            block = jacobian[:, own].T @ jacobian[:, own]
            gradient = jacobian[:, own].T @ residual
            expected = problem.cameras[camera]
            for damping in DAMPINGS:
                change = np.zeros(jacobian.shape[1])
                change[own] = -np.linalg.solve(block + damping * np.diag(np.diag(block)), gradient)
                moved = support.moved(problem, manifold, change)
                if camera_costs(moved)[camera] < before[camera]:
                    expected = moved.cameras[camera]
                    helped = helped + 1
                    break
            np.testing.assert_allclose(after.cameras[camera], expected, rtol=1e-5, atol=1e-6)
    assert helped >= 12


def test_every_camera_ends_where_scipy_ends_on_that_camera_alone():
    problem = turned(6, 0.1)
    once = camera_costs(resected(problem))
    found = camera_costs(resected(problem, 40))
    for camera in range(problem.num_cameras):
        own = problem.camera_index == camera
        points = problem.points[problem.point_index[own]]
        seen = problem.observations[own]

        def residuals(x: np.ndarray, points=points, seen=seen) -> np.ndarray:
            local = points @ geometry.rotation_matrices(x[None, :3])[0].T + x[3:6]
            intrinsics = np.broadcast_to(x[6:], (len(points), 3))
            return (support.distort(local[:, :2] / -local[:, 2:], intrinsics) - seen).ravel()

        best = least_squares(
            residuals,
            problem.cameras[camera],
            x_scale="jac",
            xtol=1e-14,
            ftol=1e-14,
            gtol=1e-14,
            max_nfev=2000,
        )
        assert best.cost <= once[camera] * (1 + 1e-9)
        np.testing.assert_allclose(found[camera], best.cost, rtol=1e-5)


def test_cameras_that_see_nothing_do_not_move():
    problem = support.odd()
    unseen = np.bincount(problem.camera_index, minlength=problem.num_cameras) == 0
    assert unseen.any()
    after = resected(problem)
    assert np.array_equal(after.cameras[unseen], problem.cameras[unseen])
    assert not np.array_equal(after.cameras[~unseen], problem.cameras[~unseen])


# Trials


_whole_step = jax.jit(solve_step, static_argnames=("options",))


@pytest.mark.parametrize("damping", [1e-3, 1.0])
def test_without_embedded_iterations_the_candidate_is_the_step_and_nothing_else(damping):
    for problem in (support.tiny(), turned(1, 0.3)):
        dense = support.dense(problem, PLAIN, damping)
        layout, before = start(problem)
        after, info = step(layout, before, damping, PLAIN)
        plain = geometry.cost(support.moved(problem, PLAIN, dense.step))
        np.testing.assert_allclose(info.candidate_cost, plain, rtol=1e-6)
        np.testing.assert_allclose(info.predicted, dense.predicted, rtol=1e-6)
        assert bool(info.accepted) == (plain < geometry.cost(problem))
        np.testing.assert_allclose(after.cost, min(plain, geometry.cost(problem)), rtol=1e-6)


def test_the_promise_at_a_share_of_the_step_is_the_quadratic_model_there():
    problem = turned(1, 0.3)
    damping = 1e-3
    layout, before = start(problem)
    linear = linearize(layout, before.cameras, before.points, PLAIN.loss)
    found = _whole_step(layout, linear, before.cameras, before.points, jnp.asarray(damping), PLAIN)
    dense = support.dense(problem, PLAIN, damping)
    for share in (1.0, 0.25, 0.0625, 0.5, 1.7):
        change = share * dense.jacobian @ dense.step
        model = -change @ (dense.residual + 0.5 * change)
        np.testing.assert_allclose(found.predicted(jnp.asarray(share)), model, rtol=1e-7)


KIND = SceneClass(5, 12)
SCENES = 80


@functools.cache
def wide() -> list[tuple[Layout, LMState]]:
    """Scenes of the game, some of them such that Gauss-Newton fails; one program for all."""
    scenes = make_scenes(KIND, jax.random.key(0), SCENES)
    costs = initial_costs(KIND, scenes)
    large = np.flatnonzero(np.asarray(scenes.mask).sum(axis=1) >= 25)
    return [
        (
            with_scene(class_layout(KIND, StepOptions()), scenes.pixels[k], scenes.mask[k]),
            LMState(scenes.cameras[k], scenes.points[k], costs[k]),
        )
        for k in large
    ]


_cost = jax.jit(cost, static_argnames=("loss",))


@pytest.mark.fully_compiled
def test_a_refused_step_is_taken_at_a_quarter_or_less_of_its_length():
    saved = 0
    for layout, before in wide():
        same, once = step(layout, before, BOLD, PLAIN)
        after, info = step(layout, before, BOLD, SHORTER_ONLY)
        if once.accepted:  # then nothing is tried again
            assert (info.repairs, info.step_fraction) == (0, 1)
            # another program, which rounds in another order, and this lambda divides rounding by
            # 1e-8
            chex.assert_trees_all_close(after, same, rtol=1e-9, atol=1e-9)
            continue
        chex.assert_trees_all_equal(same, before, strict=True)
        if not info.accepted:
            chex.assert_trees_all_equal(after, before, strict=True)
            continue
        saved += 1
        assert once.repairs == 0
        assert info.repairs == round(float(np.log(info.step_fraction) / np.log(SHORTER)))
        linear = linearize(layout, before.cameras, before.points, PLAIN.loss)
        whole = _whole_step(layout, linear, before.cameras, before.points, jnp.asarray(BOLD), PLAIN)
        power = round(float(np.log(info.step_norm / once.step_norm) / np.log(SHORTER)))
        assert power in (1, 2, 3)
        costs = []
        for share in SHORTER ** np.arange(power + 1.0):
            cameras = before.cameras + share * whole.cameras
            points = before.points + share * whole.points
            costs.append(float(_cost(layout, cameras, points, PLAIN.loss)))
        assert not min(costs[:-1]) < before.cost  # no longer share would have done
        np.testing.assert_allclose(after.cameras, cameras, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(after.points, points, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(info.predicted, whole.predicted(jnp.asarray(share)), rtol=1e-10)
        np.testing.assert_allclose(info.cost, costs[-1], rtol=1e-10)
        assert after.cost < before.cost
    assert saved >= 3


@functools.partial(jax.jit, static_argnames=("options", "min_gain"))
def _best_candidate(layout, cameras, points, cost, reference, whole, options, min_gain):
    return best_candidate(
        comparison(layout, cameras, points, cost, reference, whole, options, min_gain)
    )


def test_a_camera_whose_focal_length_would_change_its_sign_stays_where_it_was():
    layout, before = start(support.tiny())
    linear = linearize(layout, before.cameras, before.points, PLAIN.loss)
    whole = _whole_step(layout, linear, before.cameras, before.points, jnp.asarray(1e-3), PLAIN)
    mirrored = whole._replace(cameras=whole.cameras.at[6, 0].set(-1.5 * before.cameras[6, 0]))

    def found(options):
        return _best_candidate(layout, *before[:3], linear.reference, mirrored, options, 0.0)

    plain = found(PLAIN)
    kept = found(SHORTER_ONLY)
    assert plain.cameras[6, 0] < 0
    assert not plain.accepted
    assert kept.step_fraction == 1
    assert np.array_equal(kept.cameras[:, 0], before.cameras[:, 0])
    np.testing.assert_allclose(kept.cameras[:, 1:], plain.cameras[:, 1:], rtol=1e-12)


@pytest.mark.parametrize(
    "options", [PLAIN, SHORTER_ONLY, EVERYTHING], ids=["plain", "trials", "everything"]
)
def test_the_cost_never_rises_and_is_that_of_the_parameters(options):
    accepted = 0
    for problem in (support.tiny(), turned(2, 0.3), far(0), far(1), far(2)):
        for damping in (BOLD, 1e-3, 1.0):
            layout, before = start(problem)
            after, info = step(layout, before, damping, options)
            assert info.cost <= info.previous_cost
            assert after.cost == info.cost
            np.testing.assert_allclose(
                info.cost, geometry.cost(support.back(problem, before, after)), rtol=1e-9
            )
            accepted += int(info.accepted)
    assert accepted >= 5


@pytest.mark.parametrize(
    "options", [PLAIN, SHORTER_ONLY, EVERYTHING], ids=["plain", "trials", "everything"]
)
def test_a_refused_step_leaves_every_bit_alone(options):
    for problem in (turned(2, 0.3), far(0)):
        layout, before = start(problem)
        after, info = step(layout, before, 1e-3, options, min_gain=1e9)
        assert not info.accepted
        chex.assert_trees_all_equal(after, before, strict=True)
        assert info.cost == info.previous_cost


@pytest.mark.fully_compiled
def test_camera_rounds_never_make_a_candidate_worse_and_mend_some():
    rounds = StepOptions(refinement=Refinement(camera_rounds=3))
    better = trusted = 0
    for layout, before in wide():
        plain = step(layout, before, BOLD, PLAIN)[1]
        mended = step(layout, before, BOLD, rounds)[1]
        # two programs under a lambda that divides rounding by 1e-8, though not in directions that
        # cost much
        np.testing.assert_allclose(mended.predicted, plain.predicted, rtol=1e-10)
        assert not mended.candidate_cost > plain.candidate_cost * (1 + 1e-10)
        better += bool(mended.candidate_cost < 0.9 * plain.candidate_cost)
        if plain.gain_ratio > GOOD_GAIN or plain.candidate_cost > MAX_COST_RATIO * before.cost:
            trusted += 1  # the model was right, or it is past mending
            assert mended.repairs == 0
        if mended.repairs == 0:  # rounds, and nothing else, make a candidate better or worse here
            np.testing.assert_allclose(mended.candidate_cost, plain.candidate_cost, rtol=1e-10)
        assert 0 <= mended.repairs <= 3
    assert better >= 1
    assert trusted >= 5


@pytest.mark.slow
def test_a_further_round_is_made_only_where_it_may_lead_to_acceptance(monkeypatch):
    """What one round and two leave shows who is to have the next; limits in the middle of these, so
    that some are."""
    scenes = wide()
    monkeypatch.setattr(candidates, "MAX_COST_RATIO", np.inf)

    def repaired(rounds: int, *limits: float) -> tuple[np.ndarray, np.ndarray]:
        monkeypatch.setattr(candidates, "MIN_GAINS", limits)
        options = StepOptions(refinement=Refinement(camera_rounds=rounds))
        once = jax.jit(
            lambda layout, before: lm_step(layout, before, jnp.asarray(BOLD), options)[1]
        )
        infos = [once(*scene) for scene in scenes]
        return np.array([info.repairs for info in infos]), np.array(
            [info.gain_ratio for info in infos]
        )

    done, gain = repaired(1, -np.inf, -np.inf)
    limits: list[float] = []
    for rounds in (2, 3):
        lacks = (done == rounds - 1) & (gain < GOOD_GAIN)
        # between two of them: the next program may round differently
        ordered = np.sort(gain[lacks])
        limits.append(float(np.mean(ordered[len(ordered) // 2 - 1 :][:2])))
        going_on = lacks & (gain > limits[-1])
        assert 0 < going_on.sum() < lacks.sum()
        expected = done + going_on
        done, gain = repaired(rounds, *[*limits, -np.inf][:2])
        np.testing.assert_array_equal(done, expected)
    assert MIN_GAINS[0] < MIN_GAINS[1] < GOOD_GAIN


@pytest.mark.fully_compiled
def test_a_round_mends_a_shortened_candidate_and_makes_none_worse():
    with_rounds = StepOptions(refinement=Refinement(trials=4, camera_rounds=3))
    better = 0
    for layout, before in wide():
        bare = step(layout, before, BOLD, SHORTER_ONLY, min_gain=0.25)[1]
        full = step(layout, before, BOLD, with_rounds, min_gain=0.25)[1]
        shortened = round(float(np.log(full.step_fraction) / np.log(SHORTER)))
        assert shortened <= full.repairs <= 3 + shortened * (1 + ROUNDS_OF_LATER_CANDIDATES)
        # what a round brings in need not be shortened further
        assert full.step_fraction >= bare.step_fraction
        if full.step_fraction == bare.step_fraction:
            # two programs, as above
            assert not full.candidate_cost > bare.candidate_cost * (1 + 1e-10)
        lower = full.candidate_cost < 0.999 * bare.candidate_cost
        better += bool(
            full.step_fraction < 1 and (full.step_fraction > bare.step_fraction or lower)
        )
    assert better >= 1


def test_a_predicted_decrease_too_small_to_matter_is_tried_once():
    """At such a lambda the step promises next to nothing; refused, it is refused at full length."""
    layout, before = start(turned(2, 0.3))
    for damping, tries in ((1e12, 1), (1e-3, 4)):
        whole = step(layout, before, damping, PLAIN, min_gain=1e9)[1]
        assert (whole.predicted < NEGLIGIBLE * before.cost) == (tries == 1)
        last = step(layout, before, damping, SHORTER_ONLY, min_gain=1e9)[1]
        assert (last.predicted < 0.5 * whole.predicted) == (tries > 1)


# Pattern moves


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("damping", [1e-2, 1.0, 1e2])
def test_a_pattern_move_repeats_the_way_of_the_step_twice_as_far_each_time_while_that_costs_less(
    seed, damping
):
    """Where damping holds a step back: the end is 1, 2, 4, 8 or 16 ways off, by costs that NumPy
    evaluates."""
    problem = turned(seed, 0.2)
    layout, before = start(problem, PLAIN)
    once, short = step(layout, before, damping, PLAIN)
    end, info = step(layout, before, damping, MOVES_ONLY)
    assert short.accepted
    way = [np.asarray(new - old) for new, old in zip(once[:2], before[:2], strict=True)]

    def cost_at(times: float) -> float:
        moved = [np.asarray(old) + times * one for old, one in zip(before[:2], way, strict=True)]
        return float(cost(layout, *(jnp.asarray(x) for x in moved), PLAIN.loss))

    costs = [cost_at(2.0**k) for k in range(5)]
    last = next((k for k in range(4) if not costs[k + 1] < costs[k]), 4)
    held_back = (
        short.damping_fraction > SMALL_DAMPING_FRACTION
        or abs(short.gain_ratio - 1) > GAIN_TOLERANCE
    )
    last = last if held_back else 0
    np.testing.assert_allclose(info.cost, costs[last], rtol=1e-9)
    tried = min(last + 1, 4) if held_back else 0
    assert info.repairs == tried
    for new, old, one in zip(end[:2], before[:2], way, strict=True):
        np.testing.assert_allclose(new - old, 2.0**last * one, rtol=1e-6, atol=1e-9)
    assert damping < 1e2 or last > 0  # such steps are far too short


def test_a_step_that_did_what_was_promised_is_not_followed():
    """Newton's, close to the minimum: nothing is tried beyond it, and it ends where it does without
    pattern moves."""
    problem = turned(1, 1e-3)
    layout, before = start(problem, PLAIN)
    free = step(layout, before, BOLD, PLAIN)
    assert abs(free[1].gain_ratio - 1) < GAIN_TOLERANCE
    same, info = step(layout, before, BOLD, MOVES_ONLY)
    assert info.repairs == 0
    # two programs, which round differently when they are optimised
    np.testing.assert_allclose(info.cost, free[1].cost, rtol=1e-12)
    for found, expected in zip(same[:2], free[0][:2], strict=True):
        np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-12)


def test_a_refused_step_is_not_followed():
    layout, before = start(turned(1, 0.2), PLAIN)
    _, refused = step(layout, before, 1.0, MOVES_ONLY, min_gain=1e6)
    assert not refused.accepted
    assert refused.repairs == 0


@pytest.mark.slow
def test_pattern_moves_make_no_step_worse_and_a_crawl_shorter():
    """A large lambda throughout, whose steps crawl."""
    problem = turned(2, 0.2)
    lowest = solve(problem, "ceres").final_cost
    plain, moved = (
        solve(problem, make_policy("constant:1"), options).final_cost
        for options in (PLAIN, MOVES_ONLY)
    )
    assert moved - lowest < 0.5 * (plain - lowest)
    for layout, before in wide():
        bare, followed = (step(layout, before, 1e-2, options)[1] for options in (PLAIN, MOVES_ONLY))
        assert followed.accepted == bare.accepted
        assert followed.cost <= bare.cost * (1 + 1e-12)  # two programs
