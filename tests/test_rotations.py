"""Rotations against SciPy."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxba.rotations import angle_axis, rotation_matrix


@pytest.mark.parametrize(
    "angle", [0.0, 1e-14, 1e-8, 1e-3, 1.0, 3.0, np.pi - 1e-3, np.pi - 1e-8, np.pi - 1e-12, np.pi]
)
def test_angle_axis_vectors_are_those_of_scipy(angle):
    axes = np.random.default_rng(0).normal(size=(30, 3))
    axes = np.vstack([axes, np.eye(3), -np.eye(3)])
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    rotation = Rotation.from_rotvec(angle * axes)
    found = np.array(angle_axis(jnp.asarray(rotation.as_matrix())))
    assert (np.linalg.norm(found, axis=1) <= np.pi + 1e-12).all()
    assert (Rotation.from_rotvec(found) * rotation.inv()).magnitude().max() < 1e-7 * angle + 1e-13
    if angle < np.pi - 1e-6:  # beyond, either sign of the axis is right within rounding
        np.testing.assert_allclose(found, angle * axes, rtol=1e-7, atol=1e-12)


def test_the_logarithm_has_derivatives_at_no_rotation():
    """Backwards, too: relative poses that fit exactly have none of it."""

    def of(w):
        return angle_axis(rotation_matrix(w[:, None])[..., 0][None])[0]

    for differentiate in (jax.jacrev, jax.jacfwd):
        np.testing.assert_allclose(differentiate(of)(jnp.zeros(3)), np.eye(3), atol=1e-12)
