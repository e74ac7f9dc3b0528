"""One iteration of Levenberg-Marquardt for a given lambda.

From the parameters x with cost f(x):

    propose    (H + D) d = -g                       one linear solve, lm/damped_step.py
    try_step   rho = (f(x) - f(x + d)) / (m(0) - m(d))
               x <- x + d  if  f(x + d) < f(x)  and  rho > min_gain,  else x stays

where m is the linear model and rho the gain ratio. With the options of `Refinement`, `try_step` also improves x + d
without another linear solve (refinement/candidates.py). A damping policy chooses lambda between iterations.

`lm_step` is a pure function: it compiles once per problem shape and `StepOptions` and runs under `vmap`. It never
branches in Python on a computed value: a failed factorisation or an overflow gives a candidate with a non-finite cost,
which is rejected like any other bad step.
"""

from __future__ import annotations

from typing import NamedTuple, cast

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.linear.step import Effort, Step
from jaxba.lm.damped_step import solve_step
from jaxba.lm.method import Round, RoundMethod
from jaxba.lm.records import LMState, StepInfo
from jaxba.model.linearize import Reference, cost, is_weightless, linearize, only_free
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.intrinsics import POSE_SIZE
from jaxba.problem.options import StepOptions
from jaxba.problem.safe_math import safe_divide, safe_sqrt
from jaxba.refinement.acceptance import Candidate
from jaxba.refinement.candidates import best_candidate
from jaxba.refinement.subproblems import Whole
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.structure.conventions import components_first
from jaxba.structure.devices import sum_over_devices
from jaxba.structure.layout import Layout


class Proposal(NamedTuple):
    """The solution of the damped system, and the costs before the step."""

    step: Step
    reference: Reference
    weightless: Bool[Array, ""] | None = None  # see `StepInfo`; None: no


@for_traces
def initial_state(layout: Layout, problem: BundleProblem, options: StepOptions, dtype=None) -> LMState:
    """The problem's parameters in layout order, with their cost.

    Args:
        layout: made from the same problem.
        problem: start of the optimisation.
        options: the loss, and the number of previous steps to keep.
        dtype: floating point type of the solve; that of the problem's arrays if None.
    """
    check_x64(problem.cameras.dtype if dtype is None else dtype)
    if layout.unknowns.in_rigs and problem.cameras.shape[1] != POSE_SIZE + layout.unknowns.size:
        raise ValueError("a problem with rigs must be in_frames (jaxba.problem.frames); jaxba.prepare does it")
    cameras = components_first(jnp.asarray(problem.cameras, dtype))
    order = jnp.concatenate([jnp.asarray(members) for members in layout.bucket_points])
    # padding points have an index out of range and are placed at the origin
    points = components_first(jnp.asarray(problem.points, dtype).at[order].get(mode="fill", fill_value=0))
    return state_at(cameras, points, cost(layout, cameras, points, options.loss), options)


def state_at(
    cameras: Float[Array, "parameters cameras"],
    points: Float[Array, "3 points"],
    cost: Float[Array, ""],
    options: StepOptions,
) -> LMState:
    """The state before the first iteration, with zeros for the previous steps."""
    if not options.kept_steps:
        return LMState(cameras, points, cost)
    return LMState(cameras, points, cost, jnp.zeros((options.kept_steps, *cameras.shape), cameras.dtype))


@for_traces
def lm_step(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    min_gain: float | Float[Array, ""] = 0.0,
    iteration: int | Int[Array, ""] = 0,
    effort: Effort | None = None,
) -> tuple[LMState, StepInfo]:
    """One iteration: one linear solve with the given lambda, accepted or rejected.

    Without refinement it is differentiable by cameras, points, observations and lambda (the accept decision is a
    constant): forwards with every linear solver; backwards with a factorisation in full precision and a layout without
    padding, but not through loops that end when they are done, as conjugate gradients do.

    Args:
        layout: the problem's observations.
        state: current parameters and cost.
        damping: lambda; `Coordinates.scaling` says what it multiplies.
        options: static options of the step.
        min_gain: the step is accepted if the cost falls and the gain ratio exceeds this.
        iteration: number of the iteration, from 0; methods with random clusters use other ones in each.
        effort: overrides the point iterations and the repairs of the options; ignored by the method `ddlm`.

    Returns:
        The next state (unchanged after a rejection) and the record of the iteration.

    Raises:
        ValueError: cameras share lenses, and the options have another method than plain LM; or the state is float64,
            and 64 bits are not enabled in JAX.
    """
    check_x64(state.cost.dtype)
    if not options.single_solve:
        return _round(layout, state, jnp.asarray(damping, state.cost.dtype), options, min_gain, iteration)
    proposal = propose(layout, state, damping, options, iteration)
    return try_step(layout, state, damping, proposal, options, min_gain, effort)


def propose(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    iteration: int | Int[Array, ""] = 0,
) -> Proposal:
    """First part of `lm_step`: linearise and solve the damped system. Arguments as for `lm_step`."""
    _check_lenses(layout, options)
    damping = jnp.asarray(damping, state.cost.dtype)
    linear = linearize(layout, state.cameras, state.points, options.loss)
    linear = only_free(layout, linear, options.intrinsics)
    step = solve_step(layout, linear, state.cameras, state.points, damping, options, iteration, state.previous_steps)
    return Proposal(step, linear.reference, is_weightless(layout, linear, state.cost, options.loss))


def try_step(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    proposal: Proposal,
    options: StepOptions,
    min_gain: float | Float[Array, ""] = 0.0,
    effort: Effort | None = None,
) -> tuple[LMState, StepInfo]:
    """Second part of `lm_step`: evaluate the step and accept or reject it. Arguments as for `lm_step`."""
    candidate = best_candidate(Whole(layout), *state[:3], proposal.reference, proposal.step, options, min_gain, effort)
    return take_step(layout, state, damping, proposal, candidate)


def take_step(
    layout: Layout, state: LMState, damping: Float[Array, ""], proposal: Proposal, candidate: Candidate
) -> tuple[LMState, StepInfo]:
    """End of `try_step`: the state after the accept decision on a candidate, and the record. Arguments as there."""
    step = proposal.step
    tried_step = [candidate.step_fraction * step.cameras, candidate.points - state.points]
    return _advance(
        layout,
        state,
        candidate,
        tried_step,
        jnp.asarray(damping, state.cost.dtype),
        gradient_max=step.gradient_max,
        cg_iterations=step.cg_iterations,
        forcing=step.forcing,
        step_fraction=candidate.step_fraction,
        damping_fraction=jnp.clip(safe_divide(step.damped, step.slope), 0, 1),
        weightless=jnp.zeros((), bool) if proposal.weightless is None else proposal.weightless,
        **candidate.work._asdict(),
    )


def _check_lenses(layout: Layout, options: StepOptions) -> None:
    """Raises a ValueError for what a method does not support."""
    unknowns = layout.unknowns
    if unknowns.poses.several:
        apart = options.refinement.camera_rounds or options.refinement.pattern_moves
        if options.coordinates.rotation != "manifold" or apart:
            raise ValueError("rigs need rotation='manifold', and no camera rounds and pattern moves")
    if options.method is None or unknowns.plain:
        return
    if unknowns.shared or unknowns.priors:
        what = "shared lenses" if unknowns.shared else "priors"
        raise ValueError(f"{what} need plain LM, not {options.solver_name}")
    if not options.single_solve:
        raise ValueError(f"{options.solver_name} optimises all numbers of BAL cameras, and nothing else")


def _round(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    min_gain: float | Float[Array, ""],
    iteration: int | Int[Array, ""],
) -> tuple[LMState, StepInfo]:
    """One round of a `RoundMethod`, which makes its own accept decisions."""
    _check_lenses(layout, options)
    method = cast(RoundMethod, options.method)
    result = method.round(layout, *state[:3], damping, iteration, options, min_gain)
    return _advance(
        layout,
        state,
        result,
        [result.cameras - state.cameras, result.points - state.points],
        damping,
        gradient_max=result.gradient_max,
        cg_iterations=jnp.zeros((), jnp.int32),
        forcing=jnp.zeros_like(state.cost),
        step_fraction=result.step_fraction,
        damping_fraction=jnp.clip(1 - result.curvature / result.slope, 0, 1),
        weightless=result.weightless,
        **result.work._asdict(),
    )


def _advance(
    layout: Layout,
    state: LMState,
    candidate: Candidate | Round,
    tried_step: list[Array],
    damping: Float[Array, ""],
    **fields: Array,
) -> tuple[LMState, StepInfo]:
    """The state after the accept decision, and the record of the iteration.

    Args:
        layout: the problem's observations; only cameras with observations count in the parameter norm.
        state: before the iteration.
        candidate: proposed parameters, with the decision.
        tried_step: change of cameras and points that was evaluated, for its norm.
        damping: lambda.
        fields: the fields of `StepInfo` that are not set here.
    """
    choose = lambda new, old: jnp.where(candidate.accepted, new, old)
    previous = state.previous_steps
    if previous is not None:
        latest = candidate.cameras - state.cameras
        previous = choose(jnp.concatenate([latest[None], previous[:-1]]), previous)
    cameras, points, new_cost = (choose(*pair) for pair in zip(candidate[:3], state[:3], strict=True))
    after = LMState(cameras, points, new_cost, previous)
    moved, size = sum_over_devices(layout, (jnp.sum(tried_step[1] ** 2), jnp.sum(state.points**2)))
    return after, StepInfo(
        cost=after.cost,
        previous_cost=state.cost,
        candidate_cost=candidate.cost,
        predicted=candidate.predicted,
        gain_ratio=candidate.gain,
        accepted=candidate.accepted,
        damping=damping,
        step_norm=safe_sqrt(jnp.sum(tried_step[0] ** 2) + moved),
        parameter_norm=safe_sqrt(jnp.sum(jnp.where(layout.camera_seen, state.cameras, 0) ** 2) + size),
        **fields,
    )
