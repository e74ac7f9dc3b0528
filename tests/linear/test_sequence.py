"""Steps on a sequence long enough for a band and for several clusters, against the dense normal
equations."""

from __future__ import annotations

import functools
from dataclasses import replace

import numpy as np
import pytest
import support
from support import start, step

from jaxba import BundleProblem, StepOptions, build_layout
from jaxba.problem.options import ConjugateGradients
from jaxba.scenes import SceneConfig, random_scene

EXACT = StepOptions()
UNTIL_NOTHING_CHANGES = ConjugateGradients(forcing=0.0, tolerance=1e-12, max_iterations=3000)
TO_THE_END = StepOptions(linear_solver="implicit", conjugate_gradients=UNTIL_NOTHING_CHANGES)
OPTIONS = {
    "explicit": EXACT,
    "sparse": replace(TO_THE_END, linear_solver="sparse"),
    "implicit": TO_THE_END,
    "schur-jacobi": replace(
        TO_THE_END,
        conjugate_gradients=replace(UNTIL_NOTHING_CHANGES, preconditioner="schur-jacobi"),
    ),
}
DAMPING = 1e-4


@functools.cache
def sequence() -> BundleProblem:
    """70 cameras in a row, numbered at random; no point is seen by more than eight."""
    scene = random_scene(
        SceneConfig(70, 200, 800, max_depth=4.0, gap_share=0.0, revisit_share=0.0), 0
    )
    order = np.random.default_rng(0).permutation(70)
    cameras = np.empty_like(scene.cameras)
    cameras[order] = scene.cameras
    return scene.replace(cameras=cameras, camera_index=order[scene.camera_index].astype(np.int32))


@functools.cache
def truth(damping: float) -> support.Dense:
    return support.dense(sequence(), EXACT, damping)


@functools.cache
def taken(name: str, damping: float):
    layout, before = start(sequence(), OPTIONS[name])
    return before, *step(layout, before, damping, OPTIONS[name])


def test_the_sequence_is_factored_as_a_band_and_has_several_clusters():
    pairs = build_layout(sequence(), OPTIONS["explicit"]).pairs
    assert pairs is not None
    assert pairs.band is not None
    assert pairs.table is None
    clusters = build_layout(sequence(), OPTIONS["sparse"]).clusters
    assert clusters is not None
    assert len(clusters.members) == 8


@pytest.mark.parametrize("damping", [DAMPING, 1.0])
@pytest.mark.parametrize(
    "name",
    [
        "explicit",
        "implicit",
        *(pytest.param(x, marks=pytest.mark.slow) for x in ("sparse", "schur-jacobi")),
    ],
)
def test_every_solver_takes_the_dense_normal_equation_step(name, damping):
    before, after, info = taken(name, damping)
    expected = truth(damping)
    np.testing.assert_allclose(info.predicted, expected.predicted, rtol=1e-8)
    np.testing.assert_allclose(info.gradient_max, np.max(np.abs(expected.gradient)), rtol=1e-10)
    np.testing.assert_allclose(info.step_norm, np.linalg.norm(expected.step), rtol=1e-8)
    assert info.accepted
    problem = sequence()
    found = support.difference(problem, support.back(problem, before, after), OPTIONS[name])
    assert expected.norm(found - expected.step) <= 1e-8 * expected.norm(expected.step)
    size = problem.cameras.size
    cameras = found[:size].reshape(-1, 9)
    wanted = expected.step[:size].reshape(-1, 9)
    for part in (slice(0, 3), slice(3, 6), 6, 7, 8):
        assert np.linalg.norm((cameras - wanted)[:, part]) <= 1e-8 * np.linalg.norm(wanted[:, part])
    assert np.linalg.norm(found[size:] - expected.step[size:]) <= 1e-8 * np.linalg.norm(
        expected.step[size:]
    )


@pytest.mark.slow
def test_two_levels_need_at_most_half_the_iterations_of_one():
    one_level = int(taken("schur-jacobi", DAMPING)[2].cg_iterations)
    for name in ("sparse", "implicit"):
        two_level = int(taken(name, DAMPING)[2].cg_iterations)
        assert 0 < two_level <= one_level / 2
    assert one_level < UNTIL_NOTHING_CHANGES.max_iterations
    assert taken("explicit", DAMPING)[2].cg_iterations == 0
