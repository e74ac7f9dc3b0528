"""The two-level preconditioner where frames and lenses are shared, something is constant, or there
are priors.

The truth is the damped system made densely from the rows of the linear model. The coarse level is a
projection that is orthogonal in S where its matrix is that of its motions, and these are motions of
what is shared; then it adds at most one to an eigenvalue of `M^-1 S`, and lowers none."""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from random_problems import draw
from scipy.linalg import block_diag

from jaxba import StepOptions, build_layout, initial_state
from jaxba.linear.preconditioners import preconditioner
from jaxba.linear.schur import DampedSystem
from jaxba.model.linearize import linearize, only_free
from jaxba.problem.frames import in_frames
from jaxba.problem.options import Coordinates
from jaxba.runtime.compilation import compiler_options
from jaxba.structure import camera_clusters
from jaxba.structure.residual_slots import laid_out

OPTIONS = StepOptions(linear_solver="implicit", coordinates=Coordinates(rotation="manifold"))
KINDS = {
    "free places, priors of positions": 25,
    "free places, constant pose and points": 15,
    "constant places, surveyed points": 23,
    "free places, a scale bar": 21,
    "no rigs, a constant pose": 3,
}
SLOW = (
    "free places, priors of positions",
    "constant places, surveyed points",
    "free places, a scale bar",
)


@functools.partial(jax.jit, compiler_options=compiler_options("quick"))
def parts(layout, problem, damping):
    """The linear model, D of cameras and points, T's projection, and both preconditioners as
    matrices."""
    state = initial_state(layout, problem, OPTIONS, jnp.float64)
    linear = only_free(layout, linearize(layout, state.cameras, state.points, OPTIONS.loss), "free")
    system = DampedSystem.of(layout, linear, state.cameras, state.points, damping, OPTIONS)
    shape = system.cameras.right.shape
    project = layout.unknowns.project
    unit = jnp.eye(shape[0] * shape[1]).reshape(-1, *shape)

    def of(operator):
        return jax.vmap(operator)(unit).reshape(len(unit), -1)

    inverses = [preconditioner(system, None, name) for name in ("schur-jacobi", "two-level")]
    between = [of(lambda x, inverse=inverse: project(inverse(project(x)))) for inverse in inverses]
    return linear, system.cameras.own, system.points.damping, of(project), between


@pytest.mark.parametrize("damping", [1e-8, 1e-3])
@pytest.mark.parametrize(
    "kind", [pytest.param(kind, marks=pytest.mark.slow if kind in SLOW else ()) for kind in KINDS]
)
def test_the_coarse_level_raises_the_least_eigenvalue_and_none_by_more_than_one(
    kind, damping, monkeypatch
):
    monkeypatch.setattr(camera_clusters, "CLUSTER_CAMERAS", 4)
    problem = laid_out(in_frames(draw(KINDS[kind])[0]))
    layout = build_layout(problem, OPTIONS)
    linear, own, of_points, projector, inverses = parts(layout, problem, jnp.asarray(damping))
    rows = 2 * len(layout.slot_camera)
    camera = np.zeros((rows, *own.shape[:2]))
    point = np.zeros((rows, 3, len(of_points[0])))
    for k in range(2):
        at = np.arange(k, rows, 2)
        camera[at, layout.slot_camera] = np.transpose(linear.camera_jacobian[k])
        point[at, :, layout.slot_point] = np.transpose(linear.point_jacobian[k])
    camera = camera.reshape(rows, -1)
    point = point.reshape(rows, -1)
    coupling = camera.T @ point
    schur = camera.T @ camera + block_diag(*own)
    schur -= coupling @ np.linalg.solve(
        point.T @ point + np.diag(np.concatenate(of_points)), coupling.T
    )

    values, vectors = np.linalg.eigh(projector)
    basis = vectors[:, values > 0.5]
    root = np.linalg.cholesky(basis.T @ schur @ basis)
    one, two = (
        np.linalg.eigvalsh(root.T @ basis.T @ inverse @ basis @ root) for inverse in inverses
    )
    assert two[0] > 2 * one[0]
    assert np.all(two >= one * (1 - 1e-6))
    assert np.all(two <= (one + 1) * (1 + 1e-6))
