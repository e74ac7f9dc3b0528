"""Conjugate gradients against SciPy's algebra, JAX's own implementation, and the promises of the
stopping rules."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from textbook_cg import PRECONDITIONERS, SIZE, by_hand, right, spd

from jaxba.linear.conjugate_gradients import conjugate_gradients

ALWAYS = {"forcing": 0.0, "tolerance": 0.0}
"""Neither of the early stops."""


@functools.partial(jax.jit, static_argnames=("forcing", "tolerance", "max_iterations"))
def run(matrix, b, inverse, *, forcing, tolerance, max_iterations):
    """`conjugate_gradients` on vectors of shape (n, 3), as the solver has them in blocks."""

    def times(m):
        return lambda x: (m @ x.reshape(-1)).reshape(x.shape)

    return conjugate_gradients(
        times(matrix),
        b,
        times(inverse),
        forcing=forcing,
        tolerance=tolerance,
        max_iterations=max_iterations,
    )


@pytest.mark.parametrize("kind", list(PRECONDITIONERS))
def test_iterates_are_those_of_jax(kind):
    """`jax.scipy.sparse.linalg.cg` on the same operator with the same preconditioner, cut off at
    the same count."""
    matrix = spd(1e3)
    b = right()
    inverse = PRECONDITIONERS[kind](matrix)
    for count in (1, 2, 5, 11):
        found, done = run(matrix, b, inverse, **ALWAYS, max_iterations=count)
        expected, _ = jax.scipy.sparse.linalg.cg(
            lambda x: jnp.asarray(matrix) @ x,
            jnp.asarray(b.reshape(-1)),
            M=lambda x, inverse=inverse: jnp.asarray(inverse) @ x,
            tol=0.0,
            maxiter=count,
        )
        assert done == count
        np.testing.assert_allclose(found.reshape(-1), expected, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(
            found.reshape(-1), by_hand(matrix, b, inverse, count)[-1], rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("kind", ["diagonal", "blocks"])
def test_columns_that_are_divided_by_something_make_the_same_iterates(kind):
    """DeepLM divides columns by `1 + |J_j|`: with a preconditioner of diagonal blocks that changes
    no step."""
    matrix = spd(1e3)
    b = right()
    scale = 1 / (1 + np.sqrt(np.diag(matrix)))
    scaled = matrix * scale * scale[:, None]
    for count in (1, 3, 8):
        found = [
            np.asarray(
                run(
                    a,
                    rest.reshape(b.shape),
                    PRECONDITIONERS[kind](a),
                    **ALWAYS,
                    max_iterations=count,
                )[0]
            )
            for a, rest in ((matrix, b.ravel()), (scaled, scale * b.ravel()))
        ]
        np.testing.assert_allclose(
            scale * found[1].ravel(), found[0].ravel(), rtol=1e-9, atol=1e-12
        )


@pytest.mark.parametrize("condition", [1e1, 1e4, 1e8])
def test_convergence_gives_the_solution_of_numpy(condition):
    matrix = spd(condition)
    b = right()
    found, count = run(matrix, b, np.eye(SIZE), forcing=0.0, tolerance=1e-14, max_iterations=5000)
    expected = np.linalg.solve(matrix, b.reshape(-1))
    error = found.reshape(-1) - expected
    assert error @ matrix @ error <= (1e-9**2) * (expected @ matrix @ expected)
    assert 1 <= count < 5000


def test_zero_forcing_switches_the_test_on_the_model_off():
    """Late iterations lower the model by less than its rounding error, so that it may seem to rise:
    with a forcing term of zero that is no reason to stop. A negative one can hardly stop
    anything."""
    for seed in range(10):
        stops = {"tolerance": 1e-12, "max_iterations": 5000}
        found, count = run(spd(1e8, seed), right(seed), np.eye(SIZE), forcing=0.0, **stops)
        expected, needed = run(spd(1e8, seed), right(seed), np.eye(SIZE), forcing=-1e30, **stops)
        assert (seed, count) == (seed, needed)
        assert np.array_equal(found, expected)


def test_as_many_iterations_as_different_eigenvalues():
    basis = np.linalg.qr(np.random.default_rng(0).normal(size=(SIZE, SIZE)))[0]
    matrix = basis * np.repeat([1.0, 4.0, 9.0], SIZE // 3) @ basis.T
    found, count = run(
        matrix, right(), np.eye(SIZE), forcing=0.0, tolerance=1e-12, max_iterations=100
    )
    assert count == 3
    np.testing.assert_allclose(matrix @ found.reshape(-1), right().reshape(-1), rtol=1e-10)


def test_the_inverse_as_preconditioner_needs_one_iteration():
    matrix = spd(1e3)
    found, count = run(
        matrix, right(), np.linalg.inv(matrix), forcing=0.0, tolerance=1e-9, max_iterations=100
    )
    assert count == 1
    np.testing.assert_allclose(matrix @ found.reshape(-1), right().reshape(-1), rtol=1e-8)


@pytest.mark.parametrize("forcing", [0.5, 0.1, 1e-2, 1e-3])
def test_the_forcing_term_stops_where_ceres_stops(forcing):
    """First i with `i (Q_i - Q_(i-1)) / Q_i < forcing`, `Q = x.Ax - 2 b.x`, computed from the
    textbook iterates."""
    matrix = spd(40)
    b = right()
    inverse = np.eye(SIZE)
    flat = b.reshape(-1)
    models = [0.0] + [x @ matrix @ x - 2 * flat @ x for x in by_hand(matrix, b, inverse, SIZE)]
    expected = next(
        i for i in range(1, SIZE) if i * (models[i] - models[i - 1]) / models[i] < forcing
    )
    found, count = run(matrix, b, inverse, forcing=forcing, tolerance=0.0, max_iterations=500)
    assert count == expected
    np.testing.assert_allclose(
        found.reshape(-1), by_hand(matrix, b, inverse, expected)[-1], rtol=1e-8, atol=1e-11
    )


def test_a_larger_forcing_term_never_needs_more_iterations():
    counts = [
        int(
            run(
                spd(40), right(), np.eye(SIZE), forcing=forcing, tolerance=1e-12, max_iterations=500
            )[1]
        )
        for forcing in (0.5, 0.1, 1e-2, 1e-3, 0.0)
    ]
    assert counts == sorted(counts)
    assert counts[0] < counts[-1]


def test_the_tolerance_is_a_share_of_the_right_hand_side():
    matrix = spd(100)
    b = right()
    for tolerance in (1e-1, 1e-3, 1e-6):
        found, count = run(
            matrix, b, np.eye(SIZE), forcing=0.0, tolerance=tolerance, max_iterations=500
        )
        residuals = [
            np.linalg.norm(b.reshape(-1) - matrix @ x) / np.linalg.norm(b)
            for x in by_hand(matrix, b, np.eye(SIZE), int(count))
        ]
        assert residuals[-1] <= tolerance * (1 + 1e-6)
        assert all(r > tolerance * (1 - 1e-6) for r in residuals[:-1])
        scaled, same = run(
            matrix, 2.0**20 * b, np.eye(SIZE), forcing=0.0, tolerance=tolerance, max_iterations=500
        )
        assert same == count
        assert np.array_equal(scaled, 2.0**20 * np.asarray(found))


def test_negative_curvature_ends_with_the_iterate_so_far():
    matrix = np.diag(np.append(np.linspace(1, 2, SIZE - 1), -1e-3))
    b = right()
    reached = by_hand(matrix, b, np.eye(SIZE), SIZE)
    found, count = run(matrix, b, np.eye(SIZE), **ALWAYS, max_iterations=100)
    assert 1 <= count < SIZE
    np.testing.assert_allclose(found.reshape(-1), reached[int(count) - 1], rtol=1e-8, atol=1e-10)


def test_negative_curvature_at_once_gives_zero():
    found, count = run(-np.eye(SIZE), right(), np.eye(SIZE), **ALWAYS, max_iterations=100)
    assert count == 0
    assert not np.any(found)


def test_a_zero_right_hand_side_has_a_zero_solution_and_costs_nothing():
    found, count = run(
        spd(10), np.zeros((SIZE // 3, 3)), np.eye(SIZE), **ALWAYS, max_iterations=100
    )
    assert count == 0
    assert not np.any(found)


@pytest.mark.parametrize("place", ["right-hand side", "preconditioner", "operator"])
@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_number_that_is_not_finite_makes_the_result_not_finite(place, bad):
    """Else a failed factorisation would look like a zero step."""
    matrix = spd(10)
    b = right()
    inverse = np.eye(SIZE)
    target = {"right-hand side": b, "preconditioner": inverse, "operator": matrix}[place]
    target[0, 0] = bad
    found, count = run(matrix, b, inverse, forcing=0.1, tolerance=1e-6, max_iterations=100)
    assert not np.isfinite(found).all()
    assert count <= 100


def test_a_batch_of_systems_equals_a_loop_of_systems():
    # well conditioned: the rounding of a product, which a batch may change, grows with the
    # iterations
    matrices = np.stack([spd(condition, seed) for seed, condition in enumerate((2, 5, 12, 30))])
    b = np.stack([right(seed) for seed in range(4)])

    def solve(m, b):
        return run(m, b, jnp.eye(SIZE), forcing=1e-3, tolerance=1e-9, max_iterations=200)

    found, counts = jax.vmap(solve)(matrices, b)
    for k in range(4):
        alone, count = solve(matrices[k], b[k])
        assert counts[k] == count
        np.testing.assert_allclose(found[k], alone, rtol=1e-8, atol=1e-12)
