"""Robust losses against Ceres' definitions and their own derivatives."""

from __future__ import annotations

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import published_loss

from jaxba import Loss
from jaxba.problem.losses import NAMES

SQUARES = np.concatenate(
    [[0.0, 1e-300, 1e-12], np.geomspace(1e-6, 1e8, 200), [0.25, 1.0, 4.0, 6.25]]
)
"""Squared residuals from zero to outliers, and exactly where a loss of scale 0.5, 1, 2 or 2.5
bends."""


@pytest.mark.parametrize("scale", [0.5, 1.0, 2.5])
@pytest.mark.parametrize("name", NAMES)
def test_value_and_derivative_are_those_that_ceres_publishes(name, scale):
    value, slope = Loss(name, scale)(jnp.asarray(SQUARES))
    expected_value, expected_slope = published_loss(name, scale, SQUARES)
    # sqrt(1 + s) - 1 and 1 - (1 - s)^3 are known to one rounding of scale^2, not of s
    np.testing.assert_allclose(value, expected_value, rtol=1e-13, atol=1e-15 * scale**2)
    np.testing.assert_allclose(slope, expected_slope, rtol=1e-13)


@pytest.mark.parametrize("name", NAMES)
def test_derivative_equals_the_central_difference_of_the_value(name):
    loss = Loss(name, 1.5)
    s = np.geomspace(1e-2, 1e3, 60)
    s = s[np.abs(s - 1.5**2) > 1e-3]
    h = 1e-5 * s
    difference = (loss(jnp.asarray(s + h))[0] - loss(jnp.asarray(s - h))[0]) / (2 * h)
    np.testing.assert_allclose(loss(jnp.asarray(s))[1], difference, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_derivative_equals_automatic_differentiation_and_is_finite_at_zero(name):
    loss = Loss(name, 0.7)
    slope = jax.vmap(jax.grad(lambda s: loss(s[None])[0][0]))(jnp.asarray(SQUARES))
    assert np.isfinite(slope).all()
    smooth = np.abs(SQUARES - 0.49) > 1e-9
    np.testing.assert_allclose(slope[smooth], loss(jnp.asarray(SQUARES))[1][smooth], rtol=1e-12)


@pytest.mark.parametrize("name", NAMES)
def test_small_residuals_cost_what_they_cost_without_a_loss(name):
    """`rho(0) = 0`, `rho'(0) = 1`, `rho <= s` and `0 <= rho' <= 1`."""
    value, slope = Loss(name, 3.0)(jnp.asarray(SQUARES))
    assert value[0] == 0
    assert slope[0] == 1
    assert (value <= SQUARES * (1 + 1e-15) + 1e-15 * 3.0**2).all()
    assert ((slope >= 0) & (slope <= 1)).all()
    assert (np.diff(np.sort(value)) >= 0).all()
    wide, _ = Loss(name, 1e9)(jnp.asarray(SQUARES))
    np.testing.assert_allclose(wide, SQUARES, rtol=1e-9, atol=1e-200)


def test_a_loss_of_ones_own_that_is_not_elementwise_is_refused_in_one_line():
    with pytest.raises(ValueError, match=r"a loss is elementwise: .* of shape \(207,\) gave \(\)"):
        Loss(lambda s: jnp.sum(s))(jnp.asarray(SQUARES))


def test_only_the_squared_loss_is_trivial_and_it_ignores_its_scale():
    assert [name for name in NAMES if Loss(name).trivial] == ["squared"]
    assert Loss() == Loss("squared", 1.0)
    np.testing.assert_allclose(Loss("squared", 7.0)(jnp.asarray(SQUARES))[0], SQUARES, rtol=1e-15)


@pytest.mark.parametrize("name", NAMES)
def test_single_precision_stays_single(name):
    value, slope = Loss(name, 2.0)(jnp.asarray(SQUARES, jnp.float32))
    assert value.dtype == slope.dtype == jnp.float32
    assert np.isfinite(value).all()


@pytest.mark.parametrize("name", NAMES)
def test_what_is_no_number_costs_no_number(name):
    """A point in a camera's plane would else be an outlier like others, and its infinite
    derivatives spoil the step."""
    value, _ = Loss(name)(jnp.asarray([jnp.inf, jnp.nan]))
    assert not np.isfinite(value).any()


def test_an_unknown_loss_is_one_line_that_lists_the_known_ones():
    with pytest.raises(ValueError, match="unknown loss 'hubert'; known: squared, huber") as caught:
        Loss("hubert")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("scale", [0.0, -1.0, float("nan"), float("inf"), 1e-200, 1e200])
def test_a_scale_that_is_not_positive_is_refused(scale):
    with pytest.raises(ValueError, match=r"scale must be (positive|finite)"):
        Loss("huber", scale)


def test_a_loss_is_a_hashable_constant():
    assert hash(Loss("huber", 2.0)) == hash(Loss("huber", 2.0))
    assert jax.tree.leaves(Loss("huber", 2.0)) == []
    with pytest.raises(dataclasses.FrozenInstanceError):
        Loss().name = "huber"  # type: ignore[misc]
