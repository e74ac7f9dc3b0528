"""Accepts or rejects the steps that Ceres computes as jaxba does its own. Needs the extra `ceres`.

Ceres itself accepts every step: its problem has an additional residual (`AcceptAnyStep`) that no parameter changes,
large before a step and zero after it. jaxba then refines the step if that is asked for, and accepts or rejects it, and
Ceres continues from the result.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.linear.schur import jacobian_product
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import Proposal, initial_state, try_step
from jaxba.model.linearize import linearize
from jaxba.peers.ceres import Run
from jaxba.peers.colmap import pyceres
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import COLMAP_FLIP as FLIP
from jaxba.problem.options import ConjugateGradients, StepOptions
from jaxba.refinement.acceptance import Step
from jaxba.runtime.jit import jit
from jaxba.solver.place import Placed
from jaxba.structure.layout import Layout, build_layout

FORCED_DECREASE = 1e200
"""Decrease of the cost by `AcceptAnyStep`, pixels squared: larger than the cost of any useful candidate."""


class AcceptAnyStep(pyceres.CostFunction):
    """A residual that makes Ceres accept any step: large at the first evaluation after `reset`, zero afterwards.

    Its Jacobian is zero, so that it does not enter the linear system. It has two residuals and depends on one point,
    as an observation does, since Ceres has code specialised for these sizes.
    """

    def __init__(self) -> None:
        super().__init__()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([3])
        self.reset()

    def reset(self) -> None:
        """Must be called before each call of Ceres."""
        self.value = float(np.sqrt(FORCED_DECREASE))

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """Writes the residuals and the zero Jacobian; called by Ceres."""
        residuals[:] = self.value, self.value
        self.value = 0.0
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = 0.0
        return True


Reported = tuple[Any, Any, Any]
"""The numbers of a step that only Ceres knows: the largest gradient entry before the step, and the iterations and the
forcing term of conjugate gradients, 0 for a direct linear solver."""


def reported(step: StepInfo) -> Reported:
    """Those of Ceres' record of a step."""
    return np.float64(step.gradient_max), np.int32(step.cg_iterations), np.float64(step.forcing)


class StepAcceptance:
    """Accepts or rejects the steps of a `Run`. Adds an `AcceptAnyStep` to the run's Ceres problem."""

    def __init__(self, run: Run, options: StepOptions, min_gain: float) -> None:
        """Builds jaxba's layout and state of the problem.

        Args:
            run: the solve; its parameters are the start.
            options: embedded iterations; options of the linear solver are ignored.
            min_gain: gain ratio that an accepted step exceeds.
        """
        # Ceres solves the linear system, so that the layout needs nothing for it and no past steps are kept
        self.options = replace(
            options,
            linear_solver="implicit",
            method=None,
            conjugate_gradients=ConjugateGradients(preconditioner="jacobi"),
            coordinates=replace(options.coordinates, rotation="manifold"),
        )
        self.run, self.min_gain = run, np.float64(min_gain)
        problem = run.colmap.start
        self.layout = jax.device_put(build_layout(problem, self.options))
        self.state = initial_state(self.layout, problem, self.options)
        self.accept_any = AcceptAnyStep()
        run.colmap.add_point_cost(self.accept_any, int(problem.point_index[0]))

    def evaluate(self, before: Any, damping: float, numbers: Reported) -> tuple[LMState, StepInfo]:
        """The next state after the step from the parameters `before` to Ceres' current ones, and the step's record.

        Args:
            before: parameters before the step, as `ColmapProblem.parameters` returns them.
            damping: lambda of the step.
            numbers: Ceres' numbers of the step.
        """
        after = self.run.colmap.parameters()
        return _evaluate(
            self.layout, self.state, before, after, np.float64(damping), numbers, self.min_gain, options=self.options
        )

    def apply(self, before: Any, damping: float, numbers: Reported) -> StepInfo:
        """As `evaluate`, and moves Ceres' problem to the next state, or back to `before` after a rejection."""
        self.state, step = jax.block_until_ready(self.evaluate(before, damping, numbers))
        if not step.accepted:
            self.run.colmap.restore(before)
            return step
        self.run.colmap.set_parameters_of(self.bundle())
        if (behind := self.run.newly_behind()).any():
            self.run.count_behind(behind)
        return step

    def bundle(self) -> BundleProblem:
        """The problem at the current state."""
        start = self.run.colmap.start
        return Placed(start, np.zeros(3), start).after(self.layout, self.layout.points, self.state, self.options)


@functools.partial(jit, static_argnames="options")
def _evaluate(
    layout: Layout,
    state: LMState,
    before: Any,
    after: Any,
    damping: Float[Array, ""],
    numbers: Reported,
    min_gain: Float[Array, ""],
    options: StepOptions,
) -> tuple[LMState, StepInfo]:
    """jaxba's acceptance test of a step between two sets of COLMAP's parameters.

    `before` and `after` are `(poses [c, 7], lenses [c, 5], points [p, 3])`.
    """
    flip = jnp.asarray(FLIP)[:, None]
    rotation = 2 * half_rotation(before[0][:, :4].T, after[0][:, :4].T)
    lens = (after[1] - before[1]).T
    cameras = jnp.concatenate(
        [flip * rotation, flip * (after[0][:, 4:] - before[0][:, 4:]).T, lens[jnp.array([0, 3, 4])]]
    )
    points = (after[2] - before[2]).at[layout.points].get(mode="fill", fill_value=0).T
    linear = linearize(layout, state.cameras, state.points, options.loss)
    residual, change = jnp.stack(linear.residual), jnp.stack(jacobian_product(layout, linear, cameras.T, points))
    slope = -jnp.sum(residual * change)
    damped = slope - jnp.sum(change * change)
    proposal = Proposal(Step(cameras, points, slope, damped, *numbers), linear.reference, jnp.zeros((), bool))
    return try_step(layout, state, damping, proposal, options, min_gain)


def half_rotation(before: Float[Array, "4 n"], after: Float[Array, "4 n"]) -> Float[Array, "3 n"]:
    """`v` with `after = exp(v) before` for unit quaternions: half of the rotation vector between them, radians."""
    v, w = before[:3], before[3]
    vector = w * after[:3] - after[3] * v - jnp.cross(after[:3], v, axis=0)
    real = w * after[3] + jnp.sum(after[:3] * v, axis=0)
    sine = jnp.linalg.norm(vector, axis=0)
    return jnp.where(sine > 0, jnp.arctan2(sine, real) / jnp.where(sine > 0, sine, 1), 1) * vector
