"""One iteration of Levenberg-Marquardt for a given lambda.

From the parameters x with cost f(x):

    propose    (H + D) d = -g                       one linear solve, lm/damped_step.py
    try_step   rho = (f(x) - f(x + d)) / (m(0) - m(d))
               x <- x + d  if  f(x + d) < f(x)  and  rho > min_gain,  else x stays

where m is the linear model and rho the gain ratio. With the options of `Refinement`, `try_step`
also improves x + d without another linear solve (refinement/candidates.py). A damping policy
chooses lambda between iterations.

`lm_step` is a pure function: it compiles once per problem shape and `StepOptions` and runs under
`vmap`. It never
branches in Python on a computed value: a failed factorisation or an overflow gives a candidate with
a non-finite cost, which is rejected like any other bad step."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.lm.damped_step import solve_step
from jaxba.lm.method import check_plain
from jaxba.lm.records import LMState, StepInfo
from jaxba.model.linearize import Reference, cost, is_weightless, linearize, only_free
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import StepOptions
from jaxba.problem.safe_math import safe_divide, safe_sqrt
from jaxba.refinement.acceptance import Candidate, Step, comparison
from jaxba.refinement.candidates import best_candidate
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.structure.devices import kept, sum_over_devices
from jaxba.structure.layout import Layout
from jaxba.typing import AnyArray


class Proposal(NamedTuple):
    """The solution of the damped system, and the costs before the step."""

    step: Step
    reference: Reference
    weightless: Bool[Array, ""]  # see `StepInfo`


@for_traces
def initial_state(
    layout: Layout, problem: BundleProblem, options: StepOptions, dtype=None
) -> LMState:
    """The parameters of a problem, the start of the optimisation, in the order of a layout that was
    made from it, with their cost, for the loss and the method of the options. `dtype` is the
    floating point type of the solve; that of the problem's arrays if None."""
    check_x64(problem.cameras.dtype if dtype is None else dtype)
    if layout.unknowns.in_rigs and problem.cameras.shape[1] != POSE_SIZE + layout.unknowns.size:
        raise ValueError(
            "a problem with rigs must be in_frames (jaxba.problem.frames); jaxba.prepare does it"
        )
    return state_of(layout, problem.cameras, problem.points, options, dtype)


def state_of(
    layout: Layout,
    cameras: Float[AnyArray, "cameras parameters"],
    points: Float[AnyArray, "points 3"],
    options: StepOptions,
    dtype=None,
) -> LMState:
    """`initial_state` of a problem's cameras and points."""
    parameters = jnp.asarray(cameras, dtype).T
    # padding points have an index out of range and are placed at the origin
    positions = jnp.asarray(points, dtype).at[layout.points].get(mode="fill", fill_value=0).T
    return LMState(parameters, positions, cost(layout, parameters, positions, options.loss))


@for_traces
def lm_step(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    min_gain: float | Float[Array, ""] = 0.0,
    iteration: int | Int[Array, ""] = 0,
) -> tuple[LMState, StepInfo]:
    """One iteration: one linear solve with the given lambda, accepted or rejected. Returns the next
    state (unchanged after a rejection) and the record of the iteration. Raises ValueError: the
    method does not support the problem (`lm.method.PLAIN_ONLY`); or the state is float64, and 64
    bits are not enabled in JAX.

    Without refinement it is differentiable by cameras, points, observations and lambda (the accept
    decision is a constant): forwards with every linear solver; backwards with a factorisation in
    full precision and a layout without padding, but not through loops that end when they are done,
    as conjugate gradients do.

    Args:
        layout: the problem's observations.
        state: current parameters and cost.
        damping: lambda; `Coordinates.scaling` says what it multiplies.
        options: static options of the step.
        min_gain: the step is accepted if the cost falls and the gain ratio exceeds this.
        iteration: number of the iteration, from 0; methods with random clusters use other ones in
            each."""
    check_x64(state.cost.dtype)
    proposal = propose(layout, state, damping, options, iteration)
    return try_step(layout, state, damping, proposal, options, min_gain)


def propose(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    iteration: int | Int[Array, ""] = 0,
) -> Proposal:
    """First part of `lm_step`: linearise and solve the damped system. Arguments as for
    `lm_step`."""
    unknowns = layout.unknowns
    if unknowns.poses.several:
        apart = options.refinement.camera_rounds or options.refinement.pattern_moves
        if options.coordinates.rotation != "manifold" or apart:
            raise ValueError(
                "rigs need rotation='manifold', and no camera rounds and pattern moves"
            )
    check_plain(options, shared_lenses=unknowns.shared, residuals=bool(layout.residuals))
    damping = jnp.asarray(damping, state.cost.dtype)
    linear = linearize(layout, state.cameras, state.points, options.loss)
    linear = only_free(layout, linear, options.intrinsics)
    jacobians = kept(layout, (linear.camera_jacobian, linear.point_jacobian))
    linear = linear._replace(camera_jacobian=jacobians[0], point_jacobian=jacobians[1])
    step = solve_step(layout, linear, state.cameras, state.points, damping, options, iteration)
    return Proposal(step, linear.reference, is_weightless(layout, linear, state.cost, options.loss))


def try_step(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    proposal: Proposal,
    options: StepOptions,
    min_gain: float | Float[Array, ""] = 0.0,
) -> tuple[LMState, StepInfo]:
    """Second part of `lm_step`: evaluate the step and accept or reject it. Arguments as for
    `lm_step`."""
    against = comparison(layout, *state, proposal.reference, proposal.step, options, min_gain)
    return take_step(layout, state, damping, proposal, best_candidate(against), options)


def take_step(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    proposal: Proposal,
    candidate: Candidate,
    options: StepOptions,
) -> tuple[LMState, StepInfo]:
    """End of `try_step`: the state after the accept decision on a candidate, and the record.
    Arguments as there."""
    step = proposal.step

    def choose(new, old):
        return jnp.where(candidate.accepted, new, old)

    after = jax.tree.map(choose, LMState(*candidate[:3]), state)
    tried = candidate.step_fraction * step.cameras, candidate.points - state.points
    moved, size = sum_over_devices(layout, (jnp.sum(tried[1] ** 2), jnp.sum(state.points**2)))
    return after, StepInfo(
        cost=after.cost,
        previous_cost=state.cost,
        candidate_cost=candidate.cost,
        predicted=candidate.predicted,
        gain_ratio=candidate.gain,
        accepted=candidate.accepted,
        damping=jnp.asarray(damping, state.cost.dtype),
        gradient_max=step.gradient_max,
        step_norm=safe_sqrt(jnp.sum(tried[0] ** 2) + moved),
        parameter_norm=safe_sqrt(
            jnp.sum(jnp.where(layout.camera_seen, state.cameras, 0) ** 2) + size
        ),
        cg_iterations=step.cg_iterations,
        forcing=step.forcing,
        step_fraction=candidate.step_fraction,
        damping_fraction=jnp.clip(safe_divide(step.damped, step.slope), 0, 1),
        weightless=proposal.weightless,
        repairs=candidate.repairs,
    )
