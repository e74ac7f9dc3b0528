"""Solvers of the reduced camera system `S x = b`.

- `explicit`: form S and factor it by Cholesky, as a band if it is one, else dense.
- `sparse`: form the non-zero blocks of S, then conjugate gradients with them.
- `implicit`: conjugate gradients without forming S; a product takes two passes over the
  observations.
- `cg`: the same, but `jax.scipy.sparse.linalg.cg` with a fixed number of iterations. Its
  derivatives are those of the solution, and reverse mode passes through it.

Source: Agarwal et al. 2010, "Bundle Adjustment in the Large"."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jax import Array
from jax.scipy.sparse.linalg import cg
from jaxtyping import Float, Int

from jaxba.linear.conjugate_gradients import conjugate_gradients
from jaxba.linear.factored import factored, in_full
from jaxba.linear.formed import apply_blocks, reduced_blocks
from jaxba.linear.preconditioners import preconditioner
from jaxba.linear.schur import DampedSystem, apply_reduced
from jaxba.problem.options import StepOptions

# what of a system is float32 in mixed precision
_IN_SINGLE = ("linear", "points", "cameras", "parameters")
# forcing term of the float64 conjugate gradients around a float32 factorisation
CORRECTION_FORCING = 1e-3


def solve_reduced(
    system: DampedSystem, options: StepOptions
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    """Solves `S x = b` for the camera step, in manifold coordinates, with the solver that the
    options name. Returns the step and the number of iterations (0 for a factorisation). The step is
    non-finite if a factorisation failed."""
    right = system.cameras.right
    mixed = options.mixed_precision
    single = system
    if mixed:
        parts = {name: getattr(system, name) for name in _IN_SINGLE}
        single = system._replace(
            **jax.tree.map(lambda x: x if x.dtype == bool else x.astype(jnp.float32), parts)
        )
    if options.linear_solver != "explicit":
        blocks = None

        def apply(x):
            return apply_reduced(single, x)

        if options.linear_solver == "sparse":
            formed = blocks = reduced_blocks(single)

            def apply(x):
                return apply_blocks(single.layout, formed, x)

        inverse = preconditioner(single, blocks, options.conjugate_gradients.preconditioner)
        step, iterations = _conjugate_gradients(single, apply, inverse, options)
        return step.astype(right.dtype), iterations
    if not mixed or in_full(system.layout):
        return factored(system)(right), jnp.zeros((), jnp.int32)
    solve = factored(single, rough=True)

    def precondition(r):
        return solve(r.astype(jnp.float32)).astype(r.dtype)

    corrected = system._replace(forcing=CORRECTION_FORCING)
    return _conjugate_gradients(
        corrected, lambda x: apply_reduced(system, x), precondition, options
    )


def _conjugate_gradients(
    system: DampedSystem,
    product: Callable[[Array], Array],
    inverse: Callable[[Array], Array],
    options: StepOptions,
) -> tuple[Float[Array, "cameras width"], Int[Array, ""]]:
    """On the range of T (structure/unknowns.py)."""
    project = system.layout.unknowns.project
    rule = options.conjugate_gradients

    def apply(x):
        return project(product(x))

    def precondition(r):
        return project(inverse(r))

    right = system.cameras.right
    if options.linear_solver == "cg":
        # it returns no count; below the rounding error its iterations would end as 0 / 0
        least = float(jnp.finfo(right.dtype).eps)
        step, _ = cg(apply, project(right), tol=least, maxiter=rule.budget, M=precondition)
        return step, jnp.full((), rule.budget, jnp.int32)
    return conjugate_gradients(
        apply,
        project(right),
        precondition,
        forcing=system.forcing,
        tolerance=rule.tolerance,
        max_iterations=rule.max_iterations,
    )
