"""One Levenberg-Marquardt step against dense float64 algebra, and what happens to steps that must
be rejected."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from support import DAMPINGS, MINIATURES, bal_file, check_step, needs_data, same_bits, start, step

from jaxba import BundleProblem, Loss, StepOptions, lm_step, make_method, read_bal
from jaxba.problem.options import ConjugateGradients, Coordinates, Refinement

pytestmark = pytest.mark.step

EXACT = StepOptions()
UNTIL_NOTHING_CHANGES = ConjugateGradients(forcing=0.0, tolerance=1e-14, max_iterations=5000)
TO_THE_END = StepOptions(linear_solver="implicit", conjugate_gradients=UNTIL_NOTHING_CHANGES)

KINDS = {
    f"{solver}-{rotation}-{scaling}": replace(
        options, coordinates=Coordinates(scaling=scaling, rotation=rotation)
    )
    for solver, options in (("explicit", EXACT), ("implicit", TO_THE_END))
    for rotation in ("angle-axis", "manifold")
    for scaling in ("diagonal", "identity")
}
SOLVERS = {
    "sparse": replace(TO_THE_END, linear_solver="sparse"),
    "cg": StepOptions(linear_solver="cg", conjugate_gradients=ConjugateGradients(budget=200)),
    "implicit-jacobi": replace(
        TO_THE_END, conjugate_gradients=replace(UNTIL_NOTHING_CHANGES, preconditioner="jacobi")
    ),
}
LOSSES = {
    name: replace(EXACT, loss=Loss(name, 1.7)) for name in ("huber", "soft_l1", "cauchy", "tukey")
}
PROBLEMS = {
    "paper-0": lambda: support.paper(0),
    "odd": support.odd,
    "single": support.single,
}
REPEATING = (
    *("explicit-angle-axis-identity", "implicit-angle-axis-diagonal", "implicit-manifold-identity"),
    *("implicit-angle-axis-identity", "soft_l1", "cauchy", "huber"),
)
"""What the other kinds have in other combinations."""

CASES = [
    *(
        pytest.param(
            support.tiny,
            options,
            id=f"tiny-{kind}",
            marks=pytest.mark.slow if kind in REPEATING else (),
        )
        for kind, options in {**KINDS, **SOLVERS, **LOSSES}.items()
    ),
    *(pytest.param(make, EXACT, id=name) for name, make in PROBLEMS.items()),
    pytest.param(support.tiny, replace(EXACT, intrinsics="fixed"), id="tiny-fixed-intrinsics"),
    pytest.param(support.odd, TO_THE_END, id="odd-implicit"),
    pytest.param(support.odd, SOLVERS["sparse"], id="odd-sparse", marks=pytest.mark.slow),
    pytest.param(support.odd, SOLVERS["cg"], id="odd-cg", marks=pytest.mark.slow),
    pytest.param(support.whitened, EXACT, id="whitened"),
    pytest.param(
        support.whitened,
        replace(TO_THE_END, loss=Loss("cauchy", 0.8)),
        id="whitened-implicit-cauchy",
    ),
    *(
        pytest.param(
            lambda name=name: read_bal(bal_file(name)),
            options,
            id=f"{name}-{kind}",
            marks=[needs_data, pytest.mark.slow],
        )
        for name in MINIATURES
        for kind, options in (("explicit", EXACT), ("implicit", TO_THE_END))
        if kind == "explicit" or name == "dubrovnik-3-7-18-pre"
    ),
]


@pytest.mark.parametrize("damping", DAMPINGS)
@pytest.mark.parametrize(("make", "options"), CASES)
def test_schur_step_equals_dense_normal_equation_step(make, options, damping):
    check_step(make(), options, damping)


# Many problems at once


@pytest.fixture(scope="module")
def sixty_four():
    """Scenes of one shape, stacked: layouts, states, and a lambda for each."""
    pairs = [start(support.paper(seed)) for seed in range(64)]
    dampings = jnp.asarray(10.0 ** np.linspace(-4, 1, 64))
    return pairs, jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs), dampings


def test_a_batch_of_steps_equals_a_loop_of_steps(sixty_four):
    pairs, (layouts, states), dampings = sixty_four
    batched = jax.jit(
        jax.vmap(lambda layout, state, damping: lm_step(layout, state, damping, EXACT))
    )
    together = batched(layouts, states, dampings)
    apart = [
        step(layout, state, damping, EXACT)
        for (layout, state), damping in zip(pairs, dampings, strict=True)
    ]
    apart = jax.tree.map(lambda *leaves: np.stack(leaves), *apart)
    assert 0 < np.sum(together[1].accepted) <= 64
    np.testing.assert_array_equal(together[1].accepted, apart[1].accepted)
    for one, other in zip(jax.tree.leaves(together[0]), jax.tree.leaves(apart[0]), strict=True):
        size = np.abs(other).max(axis=tuple(range(1, other.ndim)), keepdims=True)
        assert (np.abs(one - other) <= 1e-10 * size).all()
    for name in (
        "cost",
        "candidate_cost",
        "predicted",
        "gradient_max",
        "step_norm",
        "parameter_norm",
    ):
        np.testing.assert_allclose(
            getattr(together[1], name), getattr(apart[1], name), rtol=1e-10, err_msg=name
        )


# Compilation


def test_the_step_is_traced_once_for_all_dampings_states_and_thresholds():
    traces = []

    @jax.jit
    def counted(layout, state, damping, min_gain):
        traces.append(1)
        return lm_step(layout, state, damping, EXACT, min_gain)

    for seed in range(3):
        layout, state = start(support.paper(seed))
        for damping in (1e-6, jnp.asarray(1e-2), 3.0):
            state, _ = counted(layout, state, damping, 0.0)
            state, _ = counted(layout, state, jnp.asarray(damping), jnp.asarray(0.25))
    # a Python float is weakly typed, an array is not: two signatures of one program
    assert len(traces) <= 4


def test_shapes_depend_on_sizes_alone_for_scenes_where_all_is_visible():
    def shapes(seed):
        return [(x.shape, x.dtype) for x in jax.tree.leaves(start(support.paper(seed)))]

    assert shapes(0) == shapes(1) == shapes(17)


# Acceptance


@pytest.mark.parametrize("damping", [np.nan, np.inf, -np.inf, -2.0])
@pytest.mark.parametrize(
    "options", [EXACT, replace(EXACT, linear_solver="implicit")], ids=["explicit", "implicit"]
)
def test_a_damping_without_meaning_is_a_rejected_step_that_changes_no_bit(options, damping):
    layout, before = start(support.tiny(), options)
    after, info = step(layout, before, damping, options)
    assert not info.accepted
    assert same_bits(after, before)
    assert info.cost == before.cost == info.previous_cost


@pytest.mark.parametrize(
    "damping", [0.0, 1e-300, 1e-18, 1e-14, 1e-10, 1e-6, 1e-2, 1e2, 1e6, 1e20, 1e300]
)
def test_no_damping_lets_the_cost_rise_or_a_nan_in(damping):
    """At zero the seven gauge freedoms leave the system singular: whatever the factorisation makes
    of it. At 1e20 a step is so short that costs fall by less than what their sum is rounded by."""
    for problem in (support.tiny(), support.odd(), support.single(), support.whitened()):
        layout, before = start(problem)
        after, info = step(layout, before, damping, EXACT)
        assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(after))
        if info.accepted:
            assert after.cost < before.cost if damping <= 1e6 else after.cost <= before.cost
            assert info.gain_ratio > 0
            assert info.cost == after.cost == info.candidate_cost
        else:
            assert same_bits(after, before)


@pytest.mark.parametrize("refine_points", [0, 3])
def test_a_candidate_that_overflows_is_a_rejected_step(refine_points):
    """A pixel at 1e150 asks for steps of that size, and the distortion raises them to the fifth
    power."""
    problem = BundleProblem.create(
        [[0, 0, 0, 0, 0, 0, 1.0, 0.0, 1.0]], [[0.1, 0, -1]], [[1e150, 0]], [0], [0]
    )
    options = StepOptions(refinement=Refinement(points=refine_points))
    layout, before = start(problem, options)
    assert np.isfinite(before.cost)
    after, info = step(layout, before, 1e-4, options)
    assert not np.isfinite(info.candidate_cost)
    assert not info.accepted
    assert same_bits(after, before)


def test_a_start_that_is_not_finite_stays_as_it_is():
    """A point on its camera's plane."""
    problem = support.single()
    on_plane = problem.replace(
        cameras=np.array([[0, 0, 0, 0, 0, 0, 500.0, 0, 0]]), points=np.array([[1.0, 2.0, 0.0]])
    )
    layout, before = start(on_plane)
    assert not np.isfinite(before.cost)
    after, info = step(layout, before, 1e-4, EXACT)
    assert not info.accepted
    assert same_bits(after, before)


@pytest.mark.parametrize(
    ("changes", "forcing"),
    [
        ({}, 0.0),
        # conjugate gradients repair an exact solve
        pytest.param({"mixed_precision": True}, 0.0, marks=pytest.mark.slow),
        ({"linear_solver": "sparse"}, 0.1),
        (
            {"linear_solver": "implicit", "conjugate_gradients": ConjugateGradients(forcing=0.02)},
            0.02,
        ),
        ({"method": make_method("deeplm")}, 1e-3),
        pytest.param({"method": make_method("stba")}, 0.0, marks=pytest.mark.slow),
    ],
    ids=["explicit", "mixed", "sparse", "implicit", "deeplm", "stba"],
)
def test_a_step_says_by_which_forcing_term_it_ended(changes, forcing):
    options = StepOptions(**changes)
    _, info = step(*start(support.tiny(), options), 1e-2, options)
    assert float(info.forcing) == forcing


def test_a_step_is_taken_only_if_its_gain_exceeds_the_threshold():
    layout, before = start(support.tiny())
    _, info = step(layout, before, 1e-2, EXACT, 0.0)
    gain = float(info.gain_ratio)
    assert 0.5 < gain < 2
    for threshold, expected in (
        (gain * (1 - 1e-9), True),
        (gain, False),
        (gain * (1 + 1e-9), False),
        (np.nan, False),
    ):
        after, info = step(layout, before, 1e-2, EXACT, threshold)
        assert bool(info.accepted) == expected
        assert same_bits(after, before) != expected


def test_a_step_that_does_not_lower_the_cost_is_rejected_whatever_the_threshold():
    """Next to no damping far from the minimum: the model promises much and the cost rises."""
    problem = support.tiny()
    rng = np.random.default_rng(0)
    thrown = problem.replace(points=problem.points + 3.0 * rng.normal(size=problem.points.shape))
    layout, before = start(thrown)
    _, info = step(layout, before, 1e-8, EXACT, 0.0)
    assert info.candidate_cost > info.previous_cost
    for threshold in (0.0, -np.inf):
        after, info = step(layout, before, 1e-8, EXACT, threshold)
        assert not info.accepted
        assert same_bits(after, before)


# Properties of the step


def test_cameras_and_points_that_nobody_observes_do_not_move():
    problem = support.odd()
    layout, before = start(problem)
    after, info = step(layout, before, 1e-2, EXACT)
    assert info.accepted
    assert np.asarray(after.cameras)[:, 6].tobytes() == np.asarray(before.cameras)[:, 6].tobytes()
    assert np.asarray(before.points).shape == np.asarray(after.points).shape


@pytest.mark.parametrize("name", ["explicit", pytest.param("implicit", marks=pytest.mark.slow)])
def test_float32_steps_agree_with_float64_to_single_precision(name):
    single = ConjugateGradients(forcing=0.0, tolerance=1e-6, max_iterations=200)
    options = StepOptions(linear_solver=name, conjugate_gradients=single)
    layout, before = start(support.tiny(), options)
    after, info = step(layout, before, 1e-2, options)
    with jax.enable_x64(False):
        layout32, before32 = start(support.tiny(), options, "float32")
        after32, info32 = step(layout32, before32, 1e-2, options)
    assert after32.cost.dtype == after32.cameras.dtype == after32.points.dtype == jnp.float32
    np.testing.assert_allclose(info32.previous_cost, info.previous_cost, rtol=1e-5)
    np.testing.assert_allclose(info32.predicted, info.predicted, rtol=1e-3)
    np.testing.assert_allclose(after32.cost, after.cost, rtol=1e-3)
    assert info32.accepted


def test_the_explicit_solver_refuses_a_layout_without_pairs():
    layout, state = start(support.tiny(), replace(EXACT, linear_solver="implicit"))
    with pytest.raises(ValueError, match="no pairs"):
        step(layout, state, 1e-2, EXACT)
