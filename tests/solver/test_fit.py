"""The tests of residuals and the search for wrong rows, against dense least squares with known
deviations."""

from __future__ import annotations

import numpy as np
import pytest

from jaxba.solver.fit import Left, explained, fits, instead, is_scale

ROWS = 20
SIZE = 3
UNKNOWNS = 12


def design(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=(ROWS * SIZE, UNKNOWNS))


def left_of(jacobian: np.ndarray, values: np.ndarray, size: int = SIZE) -> Left:
    """What least squares leave, by a pseudo-inverse: half of the rows are of one kind, half of
    another."""
    cofactor = np.eye(len(jacobian)) - jacobian @ np.linalg.pinv(jacobian)
    at = np.arange(len(jacobian)).reshape(-1, size)
    return Left(cofactor @ values, cofactor, (at[: len(at) // 2], at[len(at) // 2 :]))


def test_right_deviations_fail_as_often_as_the_level_says():
    """Both tests of two kinds: 2,000 draws at a level of 5%; a rate below 2% would be a test
    without power."""
    left = left_of(design(), np.zeros(ROWS * SIZE))
    rng = np.random.default_rng(1)
    failed = 0
    for _ in range(2000):
        drawn = left.cofactor @ rng.normal(size=ROWS * SIZE)
        failed += not Left(drawn, left.cofactor, left.kinds).all_fit(0.05)
    assert 0.02 < failed / 2000 < 0.065  # 3 standard deviations of the count above the level


def test_residuals_without_their_covariance_fail_less_often():
    left = left_of(design(), np.zeros(ROWS * SIZE))
    rng = np.random.default_rng(2)
    drawn = [
        (left.cofactor @ rng.normal(size=ROWS * SIZE)).reshape(ROWS, SIZE) for _ in range(1000)
    ]
    assert np.mean([not fits(one, 0.05) for one in drawn]) < 0.05


def test_unknowns_of_rows_alone_make_the_test_of_all_rows_sharper_at_the_same_level():
    """12 unknowns of 60 numbers: half of the level is that of the sum of squares, which rows with
    standard deviations too small by 1.3 exceed more often than without the number of unknowns."""
    left = left_of(design(), np.zeros(ROWS * SIZE))
    rng = np.random.default_rng(9)
    drawn = [
        (left.cofactor @ rng.normal(size=ROWS * SIZE)).reshape(ROWS, SIZE) for _ in range(2000)
    ]
    failed = np.mean([not fits(residual, 0.05, UNKNOWNS) for residual in drawn])
    assert failed < 0.065  # as above
    sharper = np.mean([not fits(1.3 * residual, 0.05, UNKNOWNS) for residual in drawn])
    assert sharper > 1.5 * np.mean([not fits(1.3 * residual, 0.05) for residual in drawn])


def test_what_is_left_without_rows_is_what_a_solve_without_them_leaves():
    jacobian = design(3)
    values = np.random.default_rng(4).normal(size=ROWS * SIZE)
    left = left_of(jacobian, values)
    out = ((0, 2), (1, 5))
    gone = np.concatenate([left.kinds[kind][row] for kind, row in out])
    kept = np.setdiff1d(np.arange(len(values)), gone)
    step = np.linalg.lstsq(jacobian[kept], values[kept], rcond=None)[0]
    rest = left.without(out)
    np.testing.assert_allclose(rest.residual[kept], (values - jacobian @ step)[kept], atol=1e-10)
    off, square = left.without(((1, 5),)).error((0, 2))
    row = left.kinds[0][2]
    np.testing.assert_allclose(off, (values - jacobian @ step)[row], atol=1e-10)
    both = np.sort(np.concatenate([kept, row]))
    with_row = np.linalg.lstsq(jacobian[both], values[both], rcond=None)[1][0]
    np.testing.assert_allclose(
        square, with_row - np.sum((values - jacobian @ step)[kept] ** 2), rtol=1e-9
    )


def test_every_deletion_lowers_the_squares_by_its_statistic():
    jacobian = design(5)
    values = np.random.default_rng(6).normal(size=ROWS * SIZE)
    left = left_of(jacobian, values)
    squares, rank = left.deletions(0)
    assert (rank == SIZE).all()
    for row in range(ROWS // 2):
        kept = np.setdiff1d(np.arange(len(values)), left.kinds[0][row])
        rest = np.linalg.lstsq(jacobian[kept], values[kept], rcond=None)[1][0]
        np.testing.assert_allclose(squares[row], np.sum(left.residual**2) - rest, rtol=1e-8)


@pytest.mark.parametrize("suspects", [(), ((0, 1), (0, 3), (1, 0))])
def test_wrong_rows_are_found_and_no_others(suspects):
    values = np.random.default_rng(7).normal(size=ROWS * SIZE)
    values[3 * 1 + 2] += 30
    values[3 * 13] -= 500
    left = left_of(design(7), values)
    out = explained(left, suspects)
    assert out is not None
    assert set(out) == {(0, 1), (1, 3)}
    assert not is_scale(left, 0, out)


def test_deviations_that_are_all_too_small_are_no_wrong_rows():
    values = np.random.default_rng(8).normal(size=ROWS * SIZE)
    values[: ROWS * SIZE // 2] *= 3
    left = left_of(design(8), values)
    out = explained(left, ())
    assert out is None or is_scale(left, 0, out)


def test_rows_that_cannot_be_told_apart_are_named_together():
    """Three measurements of one number, two of them of the same amount against the third's: a level
    and two heights."""
    jacobian = np.array([[1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0], [0.0, 0.0]])
    left = left_of(jacobian, np.array([0.0, 50.0, 0.0, 0.0, 0.0, 0.0]), size=1)
    out = explained(left, ())
    assert out is not None
    assert len(out) == 1
    assert {*out, *instead(left, out, out[0])} == {(0, 0), (0, 1), (0, 2)}
