"""jaxba's verdict on a step of Ceres: the embedded iterations around what another library has computed.

Ceres makes the step, and never decides on it: its problem has one more error (`Forgiving`), which no parameter moves,
large before a step and zero after it, so that any candidate is taken. What becomes of it, `try_step` decides as for
jaxba's own steps, and Ceres goes on from there. Needs the extra `ceres`.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from jaxba.linear.schur import jacobian_product
from jaxba.linear.step import Step
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import Proposal, initial_state, try_step
from jaxba.model.linearize import linearize
from jaxba.peers.ceres import Run, step_of
from jaxba.peers.colmap import pyceres
from jaxba.peers.model import half_turn
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import COLMAP_FLIP as FLIP
from jaxba.problem.options import ConjugateGradients, StepOptions
from jaxba.solver.prepare import write_back
from jaxba.structure.layout import Layout, layout_for

FORGIVEN = 1e200
"""Cost that falls off with a step, pixels squared: more than any candidate costs that could be of use."""


class Forgiving(pyceres.CostFunction):
    """An error that is large when it is first evaluated after `begin`, and then zero. Its derivatives are zero, so that
    it is in no linear system; two numbers by one point, as the errors of observations, for which Ceres is compiled."""

    def __init__(self) -> None:
        super().__init__()
        self.set_num_residuals(2)
        self.set_parameter_block_sizes([3])
        self.begin()

    def begin(self) -> None:
        """Before a call of Ceres."""
        self.size = float(np.sqrt(FORGIVEN))

    def Evaluate(self, parameters: Any, residuals: Any, jacobians: Any) -> bool:
        """See the class."""
        residuals[:] = self.size, self.size
        self.size = 0.0
        if jacobians is not None and jacobians[0] is not None:
            jacobians[0][:] = 0.0
        return True


class Told(NamedTuple):
    """What Ceres says of a step."""

    gradient_max: Any  # before it
    cg_iterations: Any  # 0 after a factorisation
    forcing: Any  # of conjugate gradients, else 0

    @classmethod
    def nothing(cls) -> Told:
        """Of no step, for whoever compiles."""
        return cls(np.float64(0), np.int32(0), np.float64(0))

    @classmethod
    def of(cls, summaries: list[Any], mode: str) -> Told:
        """From the summaries of the start and the iteration."""
        step = step_of(summaries[1], summaries[0], np.nan, np.nan, mode)
        return cls(np.float64(step.gradient_max), np.int32(step.cg_iterations), np.float64(step.forcing))


class Verdict:
    """Judges the steps of a `Run`, whose problem it changes for the purpose."""

    def __init__(self, run: Run, options: StepOptions, min_gain: float) -> None:
        """Lays the problem out anew, for what surrounds a step.

        Args:
            run: its parameters are the start.
            options: what is embedded; how a step is solved does not matter.
            min_gain: gain ratio that an accepted step exceeds.
        """
        # a step is Ceres': nothing of a linear system is laid out or remembered
        self.options = replace(
            options,
            linear_solver="implicit",
            method=None,
            conjugate_gradients=ConjugateGradients(preconditioner="jacobi"),
            coordinates=replace(options.coordinates, rotation="manifold"),
        )
        self.run, self.min_gain = run, np.float64(min_gain)
        problem = run.colmap.start
        self.layout = jax.device_put(layout_for(problem, self.options))
        self.state = initial_state(self.layout, problem, self.options)
        self.forgiving = Forgiving()
        run.colmap.add(self.forgiving, int(problem.point_index[0]))

    def judged(self, before: Any, damping: float, told: Told) -> tuple[LMState, StepInfo]:
        """What becomes of the step from the parameters `before` to where Ceres' problem is now."""
        after = self.run.colmap.parameters()
        return _judged(
            self.layout, self.state, before, after, np.float64(damping), told, self.min_gain, options=self.options
        )

    def settle(self, before: Any, damping: float, told: Told) -> StepInfo:
        """`judged`, and puts Ceres' problem and this where it ends."""
        self.state, step = jax.block_until_ready(self.judged(before, damping, told))
        if not step.accepted:
            self.run.colmap.restore(before)
            return step
        self.run.colmap.move_to(self.bundle())
        if (hidden := self.run.hidden()).any():
            self.run.count(hidden)
        return step

    def bundle(self) -> BundleProblem:
        """The problem where it is now."""
        return write_back(self.run.colmap.start, self.layout, self.state, self.options)


@functools.partial(jax.jit, static_argnames="options")
def _judged(
    layout: Layout,
    state: LMState,
    before: Any,
    after: Any,
    damping: Float[Array, ""],
    told: Told,
    min_gain: Float[Array, ""],
    options: StepOptions,
) -> tuple[LMState, StepInfo]:
    """`try_step` of a step between two sets of COLMAP's parameters `(poses [c, 7], lenses [c, 5], points [p, 3])`."""
    flip = jnp.asarray(FLIP)[:, None]
    turn = 2 * half_turn(before[0][:, :4].T, after[0][:, :4].T)
    lens = (after[1] - before[1]).T
    cameras = jnp.concatenate([flip * turn, flip * (after[0][:, 4:] - before[0][:, 4:]).T, lens[jnp.array([0, 3, 4])]])
    order = jnp.concatenate([jnp.asarray(members) for members in layout.bucket_points])
    points = (after[2] - before[2]).at[order].get(mode="fill", fill_value=0).T
    linear = linearize(layout, state.cameras, state.points, options.loss)
    residual, moved = jnp.stack(linear.residual), jnp.stack(jacobian_product(layout, linear, cameras.T, points))
    slope = -jnp.sum(residual * moved)
    damped = slope - jnp.sum(moved * moved)
    proposal = Proposal(Step(cameras, points, slope, damped, *told), linear.reference)
    return try_step(layout, state, damping, proposal, options, min_gain)
