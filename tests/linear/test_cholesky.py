"""The panel Cholesky factorisation against NumPy's."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.linear import cholesky
from jaxba.linear.cholesky import MIN_UNKNOWNS, PANEL, Panels, factor_and_solve, factor_panels

solve = jax.jit(factor_and_solve)


def spd(n: int, condition: float = 1e4, seed: int = 0) -> np.ndarray:
    """Eigenvalues from 1 down to 1 / condition; the eigenvectors are those of a reflection, so none
    is sparse."""
    normal = np.random.default_rng(seed).normal(size=n)
    basis = np.eye(n) - 2 * np.outer(normal, normal) / (normal @ normal)
    matrix = basis * np.geomspace(1 / condition, 1, n) @ basis.T
    return (matrix + matrix.T) / 2


def triangle(panels: Panels) -> np.ndarray:
    """L from its panels."""
    n = sum(len(inverse) for inverse in panels.inverses)
    lower = np.zeros((n, n))
    start = 0
    for inverse, below in zip(panels.inverses, panels.below, strict=True):
        stop = start + len(inverse)
        lower[start:stop, start:stop] = np.linalg.inv(inverse)
        lower[stop:, start:stop] = below
        start = stop
    return lower


# four panels, and one more of one column
SIZES = [1, 9, MIN_UNKNOWNS - 1, MIN_UNKNOWNS, MIN_UNKNOWNS + 1]


@pytest.mark.parametrize("n", SIZES)
def test_a_system_is_solved_as_numpy_solves_it_from_its_lower_triangle_alone(n):
    matrix = spd(n)
    right = np.random.default_rng(1).normal(size=n)
    expected = np.linalg.solve(matrix, right)
    found = solve(np.where(np.tri(n, dtype=bool), matrix, 1e6), right)
    assert np.linalg.norm(found - expected) <= 1e-11 * np.linalg.norm(expected)


@pytest.mark.parametrize("n", SIZES)
def test_a_matrix_with_one_negative_eigenvalue_has_no_finite_solution(n):
    matrix = spd(n)
    right = np.ones(n)
    assert np.isfinite(solve(matrix - 0.9e-4 * np.eye(n), right)).all()
    assert not np.isfinite(solve(matrix - 1.1e-4 * np.eye(n), right)).all()


@pytest.mark.parametrize("n", [MIN_UNKNOWNS - 1, MIN_UNKNOWNS])
def test_units_of_the_unknowns_do_not_matter(n):
    """Focal lengths in pixels beside rotations in radians: the scale spans 24 orders of
    magnitude."""
    matrix = spd(n)
    right = np.random.default_rng(1).normal(size=n)
    unit = np.random.default_rng(2).permutation(np.geomspace(1e-6, 1e6, n))
    found = solve(matrix * unit[:, None] * unit, right * unit) * unit
    expected = np.linalg.solve(matrix, right)
    assert np.linalg.norm(found - expected) <= 1e-10 * np.linalg.norm(expected)


@pytest.mark.parametrize("n", [MIN_UNKNOWNS - 1, MIN_UNKNOWNS])
@pytest.mark.parametrize("value", [-1.0, 0.0, np.nan])
def test_one_bad_entry_on_the_diagonal_is_enough_in_the_first_panel_and_in_the_last(n, value):
    for place in (0, n - 1):
        matrix = np.eye(n)
        matrix[place, place] = value
        assert not np.isfinite(solve(matrix, np.ones(n))).all()


@pytest.mark.parametrize("n", [MIN_UNKNOWNS - 1, MIN_UNKNOWNS])
def test_float32_is_solved_to_single_precision(n):
    matrix = spd(n, condition=100)
    right = np.random.default_rng(1).normal(size=n)
    found = solve(matrix.astype(np.float32), right.astype(np.float32))
    assert found.dtype == jnp.float32
    expected = np.linalg.solve(matrix, right)
    assert np.linalg.norm(found - expected) <= 100 * np.finfo(np.float32).eps * np.linalg.norm(
        expected
    )


@pytest.mark.parametrize("n", [1, PANEL - 1, PANEL, PANEL + 1, 2 * PANEL, 2 * PANEL + 37])
def test_panels_multiply_back_to_the_matrix(n):
    matrix = spd(n)
    panels = jax.jit(factor_panels)(matrix)
    assert [len(inverse) for inverse in panels.inverses] == [
        min(PANEL, n - k) for k in range(0, n, PANEL)
    ]
    lower = triangle(panels)
    assert np.linalg.norm(lower @ lower.T - matrix) <= 1e-13 * np.linalg.norm(matrix)
    np.testing.assert_allclose(lower, np.linalg.cholesky(matrix), rtol=0, atol=1e-11)


@pytest.mark.parametrize(
    ("n", "sizes"), [(32, [8, 8, 8, 8]), (33, [9, 9, 9, 6]), (41, [11, 11, 11, 8])]
)
def test_large_systems_get_wider_panels_instead_of_more(monkeypatch, n, sizes):
    """As with more than 24 panels of 128, at the size of a test."""
    monkeypatch.setattr(cholesky, "PANEL", 8)
    monkeypatch.setattr(cholesky, "MAX_PANELS", 4)
    matrix = spd(n, condition=100)
    right = np.random.default_rng(1).normal(size=n)
    panels, found = jax.jit(lambda a, b: ((p := factor_panels(a)), p.solve(b)))(matrix, right)
    assert [len(inverse) for inverse in panels.inverses] == sizes
    lower = triangle(panels)
    np.testing.assert_allclose(lower @ lower.T, matrix, rtol=0, atol=1e-13)
    np.testing.assert_allclose(found, np.linalg.solve(matrix, right), rtol=1e-10, atol=1e-11)
