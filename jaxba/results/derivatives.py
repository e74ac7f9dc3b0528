"""Derivatives of what a solve finds, by the implicit function theorem.

At a minimum the gradient g of the cost by the unknowns y vanishes, g(y, theta) = 0, where theta are
observations, their whitening, measured positions and what is constant. So

    dy/dtheta = -H^-1 dg/dtheta,    H = dg/dy,

with the exact Hessian H, not its Gauss-Newton approximation. Reverse mode takes one solve with H:
conjugate gradients with products by forward over reverse mode, preconditioned by the Schur
complement of the Gauss-Newton system, that is, by the linear solver of the solve itself. Nothing is
differentiated through iterations. Where symmetries leave an orbit of minima (problem/freedoms.py),
H is singular along it: y moves orthogonally to the orbit, by the pseudo-inverse.

Source: Griewank and Walther 2008, "Evaluating Derivatives", chapter 15; Blondel et al. 2022,
"Efficient and Modular Implicit Differentiation"."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Float, Int

from jaxba.damping import DampingPolicy
from jaxba.linear.reduced_system import solve_reduced
from jaxba.linear.schur import DampedSystem, back_substitute, lift_to_cameras
from jaxba.lm.records import LMState
from jaxba.lm.step import state_of
from jaxba.model import camera
from jaxba.model.linearize import cost, linearize, only_free
from jaxba.problem.bundle_problem import BundleProblem, ProblemError, check_is_problem
from jaxba.problem.facing import facing_away
from jaxba.problem.freedoms import (
    RESOLVED,
    SIMILARITY,
    determined_directions,
    fixed_freedoms,
    free_directions,
)
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import ConjugateGradients, StepOptions
from jaxba.problem.residuals import Residuals
from jaxba.problem.rigs import EXTRINSICS_SIZE
from jaxba.rotations import compose_left, rotation_matrix
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, is_traced, numerics
from jaxba.solver.loop import solve_loop
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.place import check_problem
from jaxba.solver.prepare import DEFAULT_POLICY, Setup, set_up
from jaxba.solver.solve import solve
from jaxba.structure.layout import Layout
from jaxba.structure.segment_sums import take
from jaxba.typing import AnyArray, differ, outline, same

DAMPING = 1e-10
"""lambda of the Gauss-Newton system in the preconditioner: enough that a free gauge leaves it
positive definite."""

TOLERANCE = 1e-12
"""Relative residual at which conjugate gradients with the exact Hessian stop."""

LARGEST_RESIDUAL = 1e-6
"""Relative residual above which derivatives are refused. Where the solution is determined it is
below 1e-12."""

MAX_PRODUCTS = 300
"""Most products with the exact Hessian. Where residuals are small the Gauss-Newton system is nearly
it, and ten do."""


class SolveInputs(NamedTuple):
    """What a solution depends on."""

    observations: Float[AnyArray, "observations 2"]
    """Measured pixels."""

    cameras: Float[AnyArray, "cameras parameters"]
    """Cameras at the start; the solution depends on what of them is constant."""

    points: Float[AnyArray, "points 3"]
    """Points at the start; the solution depends on the constant ones."""

    residuals: tuple[tuple[Float[AnyArray, "_ ..."], ...], ...] = ()
    """For the rows of each residual of the problem besides pixels (`problem.residuals.rows`) their
    data."""

    whitening: Float[AnyArray, "observations 2 2"] | None = None
    """`Sigma^(-1/2)` of each observation (1 / pixels); None: that of the problem, without a
    derivative."""

    __eq__, __ne__, __repr__, __hash__ = same, differ, outline, None  # pyright: ignore[reportAssignmentType]


def inputs_of(problem: BundleProblem) -> SolveInputs:
    """The numbers of a problem that `differentiable_solve` takes. Raises ValueError: it is none."""
    check_is_problem(problem)
    data = tuple(rows.data for rows in problem.residuals.rows)
    return SolveInputs(
        problem.observations, problem.cameras, problem.points, data, problem.whitening
    )


def differentiable_solve(
    problem: BundleProblem,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
) -> Callable[[SolveInputs], tuple[Float[Array, "cameras parameters"], Float[Array, "points 3"]]]:
    """A solve as a function with derivatives: from `SolveInputs` to the cameras and points at the
    minimum.

    Reverse mode works (`jax.grad`, `jax.vjp`, `jax.jacrev`). Inside `jax.jit` and `jax.vmap` the
    solve is the compiled loop of `jaxba.solve_loop`, where which images face away is that of the
    problem; outside it is `solve`, which compiles in less time. 64 bits must be enabled in JAX. The
    start is that of the inputs, and the minimum that it leads to counts as a function of them.

    A free gauge leaves an orbit of minima, and a point that is seen once a ray of them. The
    derivative is that of the minimum that moves at right angles to these (in radians and scene
    units). What is the same on all of an orbit, as lenses, angles, ratios of distances, and aligned
    cameras, has no other derivative; the rest of what a solve finds also depends on its way there,
    which differences see and derivatives do not.

    The problem says everything that the inputs do not: who sees what, lenses, constants, priors,
    rigs. `policy` and
    `options` are as for `solve`. The scale of the loss is an input as well: a loss of scale one has
    the same minimum
    where the whitening of all residuals is divided by the scale. Tolerances should be tight: the
    theorem holds at a minimum. Derivatives of the returned function raise a ProblemError if
    conjugate gradients do not solve with the Hessian, as where more than gauge and depths of points
    is not determined; inside `jax.jit` and `jax.vmap` they are NaN then."""
    check_problem(problem)
    options = checked_options(options)

    @functools.cache
    def prepared() -> _Prepared:
        with jax.ensure_compile_time_eval():  # a trace may be what asks for it
            fixed = bool(problem.residuals) and fixed_freedoms(problem) == SIMILARITY
            return _Prepared.of(problem, policy, options, facing_away(problem))._replace(
                fixed=fixed
            )

    @jax.custom_vjp
    def find(inputs: SolveInputs) -> tuple[Array, Array]:
        return forward(inputs)[0]

    def forward(inputs: SolveInputs) -> tuple[tuple[Array, Array], tuple[SolveInputs, Any]]:
        check_x64(np.float64)
        if is_traced(inputs):
            return prepared().solved(inputs)
        with numerics(np.float64):
            solved = solve(_with_inputs(problem, inputs), policy, options).problem
            return (jnp.asarray(solved.cameras), jnp.asarray(solved.points)), (inputs, solved)

    def backward(
        saved: tuple[SolveInputs, Any], cotangents: tuple[Array, Array]
    ) -> tuple[SolveInputs]:
        inputs, end = saved
        if not isinstance(end, BundleProblem):
            return (prepared().transposed(inputs, end[0], end[1], cotangents),)
        with numerics(np.float64):
            at = _Prepared.of(end, policy, options, facing_away(_with_inputs(end, inputs)))
            here = at.setup.placed.here
            symmetries = _symmetries(at.setup.placed.counted, at.setup.layout)
            return (at.transposed(inputs, here.cameras, here.points, cotangents, symmetries),)

    find.defvjp(forward, backward)
    return find


def _with_inputs(problem: BundleProblem, inputs: SolveInputs) -> BundleProblem:
    def host(x):
        return np.asarray(x, np.float64)

    pairs = zip(problem.residuals.rows, inputs.residuals, strict=True)
    rows = tuple(replace(one, data=tuple(map(host, data))) for one, data in pairs)
    return problem.replace(
        cameras=host(inputs.cameras),
        points=host(inputs.points),
        observations=host(inputs.observations),
        whitening=problem.whitening if inputs.whitening is None else host(inputs.whitening),
        residuals=replace(problem.residuals, rows=rows),
    )


class _Prepared(NamedTuple):
    """A problem for derivatives."""

    setup: Setup
    slots: Int[np.ndarray, "..."]  # which observation is in which slot of the layout
    options: SolveOptions
    fixed: bool = False  # whether residuals and constants are known to fix the gauge

    @classmethod
    def of(
        cls,
        problem: BundleProblem,
        policy: str | DampingPolicy,
        options: SolveOptions,
        away: Int[np.ndarray, " away"],
    ) -> _Prepared:
        """`away`: cameras whose views do not count."""
        setup = set_up(
            problem, policy, replace(options, pad=False, devices=1, dtype="float64"), away
        )
        if setup.placed.offset.any():
            raise ProblemError(
                "derivatives need a scene near the origin: shift it first (its extent is much "
                "smaller)"
            )
        kept = np.flatnonzero(~np.isin(problem.camera_index, away))  # observations that count
        here = setup.placed.here.camera_index
        # those that stand for other residuals, and none
        rest = np.zeros(len(here) - len(kept) + 1, int)
        return cls(setup, np.append(kept, rest)[setup.layout.observation], options)

    def solved(
        self, inputs: SolveInputs
    ) -> tuple[tuple[Array, Array], tuple[SolveInputs, tuple[Array, Array]]]:
        """The solution inside a transformation of JAX, and what `transposed` takes."""
        setup = self.setup
        (cameras, points) = self.setup.start
        model = _Model.of(setup.layout, self.slots, cameras, inputs.points, inputs)
        layout = model.with_data(inputs)
        limit = self.options.max_iterations
        start = state_of(
            layout, model.of_frames(inputs.cameras), inputs.points, setup.options, jnp.float64
        )
        end = solve_loop(
            layout, start, setup.policy, self.options.tolerances, setup.options, limit
        )[0].state
        points = jnp.asarray(inputs.points).at[layout.points].set(end.points.T, mode="drop")
        return (model.as_given(end.cameras).T, points), (inputs, (end.cameras.T, points))

    def symmetries(self, cameras: AnyArray, points: AnyArray) -> tuple[Array, Array]:
        """`_symmetries` inside a transformation of JAX."""
        setup = self.setup
        if setup.problem.residuals and not self.fixed:
            raise ProblemError(
                "inside jax.jit and jax.vmap a problem with other residuals needs a fixed gauge"
            )

        def host(cameras: Array, points: Array) -> tuple[np.ndarray, np.ndarray]:
            order = np.minimum(np.asarray(setup.layout.points), len(points) - 1)
            parts: Any = np.asarray(cameras).T, np.asarray(points).T[:, order], np.zeros(())
            state = LMState(*parts)
            solved = setup.placed.after(setup.layout, setup.layout.points, state, setup.options)
            return _symmetries(solved, setup.layout, fixed=self.fixed)

        width = setup.layout.unknowns.width
        numbers = setup.layout.num_cameras * width + 3 * len(setup.layout.points)
        shapes = (SIMILARITY, numbers), (len(setup.layout.points), 3, 3)
        found = tuple(jax.ShapeDtypeStruct(shape, jnp.float64) for shape in shapes)
        return jax.pure_callback(host, found, cameras, points, vmap_method="sequential")

    def transposed(
        self,
        inputs: SolveInputs,
        cameras: AnyArray,
        points: AnyArray,
        cotangents: tuple[Array, Array],
        symmetries: Any = None,
    ) -> SolveInputs:
        """Cotangents of the inputs for those of the solution, which has these parameters where it
        is computed."""
        step = replace(
            self.setup.options,
            coordinates=replace(self.setup.options.coordinates, rotation="manifold"),
            conjugate_gradients=ConjugateGradients(forcing=0.0, tolerance=1e-10),
        )
        layout = self.setup.layout
        slots = jnp.asarray(self.slots)
        symmetries = self.symmetries(cameras, points) if symmetries is None else symmetries
        arguments = (layout, slots, cameras, points, *symmetries, inputs, cotangents)
        found, residual = jit(_solve_transposed, once=True, static_argnames="options")(
            *arguments, options=step
        )
        if is_traced(residual):
            return jax.tree.map(lambda x: jnp.where(residual < LARGEST_RESIDUAL, x, jnp.nan), found)
        if not float(residual) < LARGEST_RESIDUAL:
            raise ProblemError(
                "the solution is not determined well enough for derivatives: the Hessian is "
                "singular"
            )
        return found


def _symmetries(
    solved: BundleProblem, layout: Layout, *, fixed: bool = False
) -> tuple[Float[np.ndarray, "7 numbers"], Float[np.ndarray, "points 3 3"]]:
    """What leaves the cost as it is: an orthonormal basis of seven directions of the gauge, zero
    for those that are not free, in all numbers of cameras and points; and the directions in which
    rays determine points, in layout order. `fixed`: it is known that none is free."""
    order = np.asarray(layout.points)
    determined = determined_directions(solved)
    cameras, points = free_directions(solved.replace(residuals=Residuals()) if fixed else solved)
    more = layout.num_cameras - solved.num_cameras
    cameras = np.pad(cameras, ((0, 0), (0, more), (0, sum(layout.unknowns.own_sizes))))
    cameras = layout.unknowns.restricted(cameras.swapaxes(1, 2)).swapaxes(1, 2)
    # only what of it is not already a motion of points along their rays
    points = np.einsum("pij,kpj->kpi", determined, points)
    real = order < solved.num_points
    at = np.minimum(order, solved.num_points - 1)
    points = np.where(real[:, None], points[:, at], 0.0).transpose(0, 2, 1)
    whole = np.hstack([x.reshape(len(x), math.prod(x.shape[1:])) for x in (cameras, points)])
    _, sizes, rows = np.linalg.svd(whole, full_matrices=False)
    basis = np.zeros((SIMILARITY, whole.shape[1]))
    moves = sizes > RESOLVED * sizes.max(initial=0.0)
    basis[: len(whole)] = np.where(moves[:, None] & (not fixed), rows, 0.0)
    return basis, np.where(real[:, None, None], determined[at], 0.0)


class _Model(NamedTuple):
    """Parameters where a problem is computed, as functions of steps of the unknowns and of the
    inputs."""

    layout: Layout
    slots: AnyArray
    cameras: Array  # as in a state
    points: Array
    given: int  # cameras of the inputs; others stand for rows of residuals
    real: int  # points of the problem; others pad

    @classmethod
    def of(
        cls,
        layout: Layout,
        slots: AnyArray,
        cameras: AnyArray,
        points: AnyArray,
        inputs: SolveInputs,
    ) -> _Model:
        """Of parameters as `Placed.here` has them."""
        found = jnp.asarray(points).at[layout.points].get(mode="fill", fill_value=0).T
        return cls(
            layout,
            jnp.asarray(slots),
            jnp.asarray(cameras).T,
            found,
            len(inputs.cameras),
            len(points),
        )

    @property
    def zero(self) -> tuple[Array, Array]:
        """No step."""
        return jnp.zeros((self.cameras.shape[1], self.layout.unknowns.width)), jnp.zeros_like(
            self.points
        )

    @property
    def end(self) -> int:
        """Where the blocks of residuals begin."""
        return len(self.cameras) - sum(self.layout.unknowns.own_sizes)

    def with_data(self, theta: SolveInputs) -> Layout:
        """The layout with what the inputs measured."""

        def in_slots(x):
            return jnp.where(
                self.layout.slot_mask, jnp.moveaxis(jnp.asarray(x), 0, -1)[..., self.slots], 0
            )

        here = replace(self.layout, pixels=in_slots(theta.observations))
        if theta.whitening is not None:
            here = replace(here, whitening=in_slots(theta.whitening))
        own = zip(here.residuals, theta.residuals, strict=True)
        return replace(
            here, residuals=tuple(replace(x, rows=replace(x.rows, data=data)) for x, data in own)
        )

    def of_frames(self, cameras: AnyArray) -> Array:
        """Cameras as the inputs have them, as those of the state."""
        state = self.cameras
        end = self.end
        cameras = jnp.concatenate([cameras, state[: cameras.shape[1], len(cameras) :].T])
        if not self.layout.unknowns.in_rigs:
            return jnp.concatenate([cameras, state[end:].T], axis=1)
        place = state[end - EXTRINSICS_SIZE : end]
        turn = rotation_matrix(place[:3])
        rows = jnp.asarray(cameras).T
        moved = jnp.einsum("jic,jc->ic", turn, rows[3:6] - place[3:], precision="highest")
        return jnp.concatenate(
            [compose_left(-place[:3], rows[:3]), moved, rows[POSE_SIZE:], place, state[end:]]
        ).T

    def moved(
        self, y: tuple[Array, Array], theta: SolveInputs, determined: Array
    ) -> tuple[Array, Array]:
        """Parameters for a step of the unknowns from the solution; what is constant is that of the
        inputs."""
        unknowns = self.layout.unknowns
        cameras = self.cameras + _start_of_constants(self.layout, self.of_frames(theta.cameras))
        points = self.points + _start_of_points(
            self.real, determined, jnp.asarray(theta.points), self.layout.points
        )
        return camera.moved(cameras, unknowns.expanded(y[0].T), unknowns), points + y[1]

    def as_given(self, cameras: Array) -> Array:
        """Cameras of a state as the solution has them."""
        unknowns = self.layout.unknowns
        if not unknowns.in_rigs:
            return cameras[: self.end, : self.given]
        own = cameras[POSE_SIZE : self.end - EXTRINSICS_SIZE]
        return jnp.concatenate([*camera.poses(cameras, unknowns), own])[:, : self.given]


def _solve_transposed(
    layout: Layout,
    slots: Array,
    cameras: AnyArray,
    points: AnyArray,
    gauge: Float[Array, "7 numbers"],
    determined: Float[Array, "points 3 3"],
    inputs: SolveInputs,
    cotangents: tuple[Array, Array],
    *,
    options: StepOptions,
) -> tuple[SolveInputs, Array]:
    model = _Model.of(layout, slots, cameras, points, inputs)
    unknowns = layout.unknowns
    order = layout.points
    zero = model.zero
    seen = jnp.asarray(layout.camera_seen)[:, None] & (
        jnp.arange(len(zero[0]))[:, None] < model.given
    )

    def project(y: tuple[Array, Array]) -> tuple[Array, Array]:
        """On the unknowns that a minimum determines, orthogonally."""
        cameras = unknowns.project(jnp.where(seen, y[0], 0))
        points = jnp.einsum("pij,jp->ip", determined, y[1], precision="highest")
        flat, unravel = ravel_pytree((cameras, points))
        along = jnp.matmul(gauge, flat, precision="highest")
        return unravel(flat - jnp.matmul(along, gauge, precision="highest"))

    def found(y: tuple[Array, Array], theta: SolveInputs) -> tuple[Array, Array]:
        """Parameters as the solution has them."""
        cameras, points = model.moved(y, theta, determined)
        return model.as_given(cameras), points

    # the cotangents in the unknowns
    _, pull = jax.vjp(lambda y: found(y, inputs), zero)
    of_points = jnp.where(order < model.real, 1.0, 0.0)
    by_points = of_points * cotangents[1].T[:, jnp.minimum(order, model.real - 1)]

    def size(y):
        return jnp.sqrt(sum(jnp.sum(part * part) for part in y))

    (whole,) = pull((cotangents[0].T, by_points))
    # where all of it is along the orbit, what is left is rounding
    right = project(whole)
    whole = size(whole)

    def along(y: tuple[Array, Array], theta: SolveInputs, step: tuple[Array, Array]) -> Array:
        """The slope of the cost along a step. Its gradient by y is H step, and by theta step .
        dg/dtheta."""

        def objective(y):
            return cost(model.with_data(theta), *model.moved(y, theta, determined), options.loss)

        return jax.jvp(objective, (y,), (step,))[1]

    def product(y: tuple[Array, Array]) -> tuple[tuple[Array, Array], SolveInputs]:
        image, by_theta = jax.grad(along, argnums=(0, 1))(zero, inputs, project(y))
        return project(image), by_theta

    inverse = _gauss_newton(model.with_data(inputs), model.cameras, model.points, options)
    tolerance = TOLERANCE * whole

    def preconditioner(y):
        return project(inverse(project(y)))

    left, through = _conjugate_gradients(product, right, preconditioner, tolerance, inputs)
    # dL/dtheta = -w . dg/dtheta, and what of the solution is constant passes directly
    direct = jax.vjp(lambda theta: found(zero, theta), inputs)[1]((cotangents[0].T, by_points))[0]
    total = jax.tree.map(lambda a, b: b - a, through, direct)
    return total, jnp.sqrt(jnp.sum(left * left)) / jnp.maximum(
        whole, jnp.finfo(right[0].dtype).tiny
    )


def _conjugate_gradients(
    product: Callable[[Any], tuple[Any, SolveInputs]],
    right: Any,
    inverse: Callable[[Any], Any],
    tolerance: Array,
    inputs: SolveInputs,
) -> tuple[Array, SolveInputs]:
    """Solves `product(x) = right` to a norm of the residual. Returns the residual, and what else
    `product` gives of the solution, like `inputs`. `product` and `inverse` stand once in the
    program, which takes long to compile: the last round of the loop has the solution in the place
    of a direction."""
    flat, unravel = ravel_pytree(right)

    def body(carry: tuple[Any, ...]) -> tuple[Any, ...]:
        x, residual, direction, before, count, *_ = carry
        scaled = ravel_pytree(inverse(unravel(residual)))[0]
        along = jnp.sum(residual * scaled)
        direction = scaled + along / before * direction
        last = (jnp.sqrt(jnp.sum(residual * residual)) <= tolerance) | (count == MAX_PRODUCTS)
        image, more = product(unravel(jnp.where(last, x, direction)))
        image = ravel_pytree(image)[0]
        step = jnp.where(last, 0.0, along / jnp.sum(direction * image))
        residual = jnp.where(last, flat - image, residual - step * image)
        return x + step * direction, residual, direction, along, count + 1, more, last

    zero = jnp.zeros_like(flat)
    nothing = jax.tree.map(jnp.zeros_like, inputs)
    start = (
        zero,
        flat,
        zero,
        jnp.full((), jnp.inf),
        jnp.zeros((), jnp.int32),
        nothing,
        jnp.asarray(False),
    )
    _, residual, *_, more, _ = jax.lax.while_loop(lambda carry: ~carry[-1], body, start)
    return residual, more


def _start_of_constants(layout: Layout, cameras: Array) -> Array:
    """Zero, with the derivative of the solution's constant numbers by those of the start."""
    unknowns = layout.unknowns
    every = jnp.ones((unknowns.width, cameras.shape[0]), cameras.dtype)
    constant = unknowns.expanded(unknowns.free.where(every, 0)).T == 0
    unseen = jnp.broadcast_to(~jnp.asarray(layout.camera_seen)[:, None], constant.shape)
    if unknowns.lenses.several:  # its lens may be that of a camera that is seen
        unseen = unseen.at[:, POSE_SIZE:].set(False)
    constant = constant | unseen
    kept = jnp.where(constant, cameras, 0)
    return (kept - jax.lax.stop_gradient(kept)).T


def _start_of_points(real: int, determined: Array, points: Array, order: AnyArray) -> Array:
    """The same for points that are constant or that nothing sees, in layout order."""
    own = points.T[:, jnp.minimum(order, real - 1)]
    kept = jnp.where(jnp.any(determined != 0, axis=(1, 2)), 0, own)
    return kept - jax.lax.stop_gradient(kept)


def _gauss_newton(
    layout: Layout, cameras: Array, points: Array, options: StepOptions
) -> Callable[[tuple[Array, Array]], tuple[Array, Array]]:
    """`(J^T J + D)^-1` by the Schur complement, as a function of a right-hand side of cameras and
    points."""
    linear = only_free(layout, linearize(layout, cameras, points, options.loss), options.intrinsics)
    damping = jnp.asarray(DAMPING, cameras.dtype)
    system = DampedSystem.of(layout, linear, cameras, points, damping, options)

    def inverse(right: tuple[Array, Array]) -> tuple[Array, Array]:
        solved = [-x for x in system.points.factor.forward(list(right[1]))]
        own = system._replace(points=system.points._replace(solved=solved))
        at_slots = take(jnp.stack(solved), layout.slot_point)
        lifted = lift_to_cameras(layout, linear, own.points.projected, at_slots)
        own = own._replace(cameras=own.cameras._replace(right=right[0] + lifted))
        step, _ = solve_reduced(own, options)
        return step, jnp.stack(back_substitute(own, step))

    return inverse
