"""The Levenberg-Marquardt step: the one piece that solver, game and benchmark share.

`lm_step` is pure: `propose`, a linear solve, and `try_step`, which looks along the step for a candidate to accept. It
compiles once per problem shape and `StepOptions`, runs under `vmap`, and never branches in Python on a value: a failed
factorisation or an overflow is a candidate with a non-finite cost, and that is a rejected step.
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
from jaxba.model.linearize import Reference, cost, linearize, with_free_lenses
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.refinement.acceptance import Candidate
from jaxba.refinement.candidates import best_candidate
from jaxba.refinement.subproblems import Whole
from jaxba.structure.conventions import components_first
from jaxba.structure.layout import Layout
from jaxba.typing import AnyArray


class Proposal(NamedTuple):
    """What the linear model proposes, and what candidates are compared with."""

    step: Step
    reference: Reference


def initial_state(layout: Layout, problem: BundleProblem, options: StepOptions, dtype=None) -> LMState:
    """The problem's parameters in layout order.

    Args:
        layout: made from the same problem.
        problem: start of the optimisation.
        options: only the loss matters, for the cost.
        dtype: floating point type of the solve; the problem's own when None.
    """
    cameras = components_first(jnp.asarray(problem.cameras, dtype))
    order = jnp.concatenate([jnp.asarray(members) for members in layout.bucket_points])
    # padding points name an index out of range; they rest at the origin
    points = components_first(jnp.asarray(problem.points, dtype).at[order].get(mode="fill", fill_value=0))
    return state_at(cameras, points, cost(layout, cameras, points, options.loss), options)


def state_at(
    cameras: Float[Array, "9 cameras"], points: Float[Array, "3 points"], cost: Float[Array, ""], options: StepOptions
) -> LMState:
    """The state before the first iteration: where everything is, its cost, and no previous steps."""
    if not options.kept_steps:
        return LMState(cameras, points, cost)
    return LMState(cameras, points, cost, jnp.zeros((options.kept_steps, *cameras.shape), cameras.dtype))


def lm_step(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    min_gain: float | Float[Array, ""] = 0.0,
    iteration: int | Int[Array, ""] = 0,
    effort: Effort | None = None,
) -> tuple[LMState, StepInfo]:
    """One iteration: one linear solve with one lambda, accepted or rejected.

    Args:
        layout: the problem's observations.
        state: current parameters.
        damping: lambda; see `StepOptions.scaling`.
        options: static.
        min_gain: the step is accepted if the cost falls and the gain ratio exceeds this.
        iteration: number of iterations done before, for methods that draw new clusters in each.
        effort: what the step may cost, instead of what the options say; has no effect in domain decomposition.

    Returns:
        The next state (the same one after a rejection) and a record of what happened.

    Raises:
        ValueError: the layout has lenses, and the solver is not the explicit one.
    """
    if not options.single_solve:
        return _round(layout, state, jnp.asarray(damping, state.cost.dtype), options, min_gain, iteration)
    proposal = propose(layout, state, damping, options, iteration, effort)
    return try_step(layout, state, damping, proposal, options, min_gain, effort)


def propose(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    iteration: int | Int[Array, ""] = 0,
    effort: Effort | None = None,
) -> Proposal:
    """The first part of `lm_step`: the linear model and its damped solution. Arguments are those of `lm_step`."""
    _check_lenses(layout, options)
    damping = jnp.asarray(damping, state.cost.dtype)
    linear = linearize(layout, state.cameras, state.points, options.loss)
    linear = with_free_lenses(layout, linear, options.intrinsics)
    step = solve_step(
        layout, linear, state.cameras, state.points, damping, options, iteration, effort, state.previous_steps
    )
    return Proposal(step, linear.reference)


def try_step(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    proposal: Proposal,
    options: StepOptions,
    min_gain: float | Float[Array, ""] = 0.0,
    effort: Effort | None = None,
) -> tuple[LMState, StepInfo]:
    """The second part of `lm_step`: candidates along a step, and whether one is accepted."""
    damping = jnp.asarray(damping, state.cost.dtype)
    step = proposal.step
    found = best_candidate(Whole(layout), *state[:3], proposal.reference, step, options, min_gain, effort)
    moved = [found.share * step.cameras, found.points - state.points]
    return _advance(
        state,
        found,
        moved,
        damping,
        layout.camera_seen,
        gradient_max=step.gradient_max,
        cg_iterations=step.cg_iterations,
        forcing=step.forcing,
        share=found.share,
        damping_share=jnp.clip(step.damped / step.slope, 0, 1),
        repairs=found.repairs,
    )


def _check_lenses(layout: Layout, options: StepOptions) -> None:
    if layout.lenses is not None and not options.factors_reduced_system:
        raise ValueError(f"shared or partly fixed lenses need the explicit solver, not {options.solver_name}")


def _round(
    layout: Layout,
    state: LMState,
    damping: Float[Array, ""],
    options: StepOptions,
    min_gain: float | Float[Array, ""],
    iteration: int | Int[Array, ""],
) -> tuple[LMState, StepInfo]:
    """A round of several solves in the place of a step: parts of it are accepted, each by itself."""
    _check_lenses(layout, options)
    method = cast(RoundMethod, options.method)
    found = method.round(layout, *state[:3], damping, iteration, options, min_gain)
    return _advance(
        state,
        found,
        [found.cameras - state.cameras, found.points - state.points],
        damping,
        layout.camera_seen,
        gradient_max=found.gradient_max,
        cg_iterations=jnp.zeros((), jnp.int32),
        forcing=jnp.zeros_like(state.cost),
        share=found.share,
        damping_share=jnp.clip(1 - found.curvature / found.slope, 0, 1),
        repairs=found.repairs,
    )


def _advance(
    state: LMState,
    found: Candidate | Round,
    moved: list[Array],
    damping: Float[Array, ""],
    seen: Bool[AnyArray, " cameras"],
    **fields: Array,
) -> tuple[LMState, StepInfo]:
    """The state after a candidate was accepted or not, and the record of it.

    `moved` is the step that was tried, `seen` are the cameras that take part; `fields` are those of
    `StepInfo` that are not set here.
    """
    choose = lambda new, old: jnp.where(found.accepted, new, old)
    previous = state.previous_steps
    if previous is not None:
        latest = found.cameras - state.cameras
        previous = choose(jnp.concatenate([latest[None], previous[:-1]]), previous)
    cameras, points, lower = (choose(*pair) for pair in zip(found[:3], state[:3], strict=True))
    after = LMState(cameras, points, lower, previous)
    return after, StepInfo(
        cost=after.cost,
        previous_cost=state.cost,
        candidate_cost=found.cost,
        predicted=found.predicted,
        gain_ratio=found.gain,
        accepted=found.accepted,
        damping=damping,
        step_norm=jnp.sqrt(sum(jnp.sum(part**2) for part in moved)),
        parameter_norm=jnp.sqrt(jnp.sum(jnp.where(seen, state.cameras, 0) ** 2) + jnp.sum(state.points**2)),
        **fields,
    )
