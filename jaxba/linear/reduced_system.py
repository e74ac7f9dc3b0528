"""Solvers of the reduced camera system `S x = b`.

- `explicit`: form S and factor it by Cholesky, as a band if it is one, else dense.
- `sparse`: form the non-zero blocks of S, then conjugate gradients with them.
- `implicit`: conjugate gradients without forming S; a product takes two passes over the observations.
- `cg`: the same, but `jax.scipy.sparse.linalg.cg` with a fixed number of iterations. Its derivatives are those of the
  solution, and reverse mode passes through it.

Source: Agarwal et al. 2010, "Bundle Adjustment in the Large".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.sparse.linalg import cg
from jaxtyping import Float, Int

from jaxba.linear.conjugate_gradients import conjugate_gradients
from jaxba.linear.factored import factored, in_full
from jaxba.linear.formed import apply_blocks, reduced_blocks
from jaxba.linear.preconditioners import preconditioner
from jaxba.linear.schur import CameraSystem, PointSystem, apply_reduced
from jaxba.linear.two_level import Anchor
from jaxba.model.linearize import Linearization
from jaxba.problem.options import StepOptions
from jaxba.structure.layout import Layout

CORRECTION_FORCING = 1e-3
"""Forcing term of the float64 conjugate gradients around a float32 factorisation; they take two or three products."""

T = TypeVar("T")


def solve_reduced(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    """Solves `S x = b` for the camera step, in manifold coordinates, with the solver that the options name.

    Args:
        layout: the problem's observations.
        linear: residuals and Jacobians.
        points: the eliminated points.
        system: B + D_c and b.
        anchor: current poses and points, for the two-level preconditioner.
        options: linear solver and precision.
        forcing: forcing term of conjugate gradients for the solvers `sparse` and `implicit`.

    Returns:
        The step and the number of iterations (0 for a factorisation). The step is non-finite if a factorisation failed.
    """
    parts = linear, points, system
    if options.linear_solver != "explicit":
        if not options.mixed_precision:
            return _iterated(layout, *parts, anchor, options, forcing)
        step, iterations = _iterated(layout, *to_single((*parts, anchor)), options, forcing)
        return step.astype(system.right.dtype), iterations
    if not options.mixed_precision or in_full(layout):
        return factored(layout, *parts)(system.right), jnp.zeros((), jnp.int32)
    solve = factored(layout, *to_single(parts), rough=True)
    precondition = lambda r: solve(r.astype(jnp.float32)).astype(r.dtype)
    product = lambda x: apply_reduced(layout, *parts, x)
    return _conjugate_gradients(layout, product, precondition, system.right, options, CORRECTION_FORCING)


def to_single(tree: T) -> T:
    """All floating point arrays in float32; booleans are unchanged."""
    return jax.tree.map(lambda x: x if x.dtype == bool else x.astype(jnp.float32), tree)


def _iterated(
    layout: Layout,
    linear: Linearization,
    points: PointSystem,
    system: CameraSystem,
    anchor: Anchor,
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    blocks = None
    apply = lambda x: apply_reduced(layout, linear, points, system, x)
    if options.linear_solver == "sparse":
        formed = blocks = reduced_blocks(layout, linear, points, system)
        apply = lambda x: apply_blocks(layout, formed, x)
    precondition = preconditioner(
        layout, linear, points, system, anchor, blocks, options.conjugate_gradients.preconditioner
    )
    return _conjugate_gradients(layout, apply, precondition, system.right, options, forcing)


def _conjugate_gradients(
    layout: Layout,
    product: Callable[[Array], Array],
    inverse: Callable[[Array], Array],
    right: Float[Array, "cameras width"],
    options: StepOptions,
    forcing: float | Float[Array, ""],
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    """On the range of T (structure/unknowns.py)."""
    project, rule = layout.unknowns.project, options.conjugate_gradients
    apply, precondition = lambda x: project(product(x)), lambda r: project(inverse(r))
    if options.linear_solver == "cg":
        # it returns no count; below the rounding error its iterations would end as 0 / 0
        least = float(jnp.finfo(right.dtype).eps)
        step, _ = cg(apply, project(right), tol=least, maxiter=rule.budget, M=precondition)
        return step, jnp.full((), rule.budget, jnp.int32)
    return conjugate_gradients(
        apply,
        project(right),
        precondition,
        forcing=forcing,
        tolerance=rule.tolerance,
        max_iterations=rule.max_iterations,
    )
