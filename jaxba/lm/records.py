"""The state of an LM iteration and the record of it: everything that a damping policy can see."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.typing import differ, outline, same


class LMState(NamedTuple):
    """Current parameters, in layout order, and their cost."""

    cameras: Float[Array, "parameters cameras"]
    """Camera parameters."""

    points: Float[Array, "3 points"]
    """Points, in layout order."""

    cost: Float[Array, ""]
    """Pixels^2."""


class StepInfo(NamedTuple):
    """Record of one iteration. A damping policy sees this and nothing else of the solve.

    That of all iterations of a solve has an array for each field, with an entry for each
    iteration."""

    cost: Float[Array, ""]
    """Accepted cost after the iteration, pixels^2."""

    previous_cost: Float[Array, ""]
    """Accepted cost before it, pixels^2."""

    candidate_cost: Float[Array, ""]
    """Cost at the proposed parameters, pixels^2; may be non-finite."""

    predicted: Float[Array, ""]
    """Decrease predicted by the linear model, pixels^2."""

    gain_ratio: Float[Array, ""]
    """Actual over predicted decrease."""

    accepted: Bool[Array, ""]
    """Whether the candidate replaced the parameters."""

    damping: Float[Array, ""]
    """Lambda of this iteration."""

    gradient_max: Float[Array, ""]
    """Largest absolute gradient entry before the step."""

    step_norm: Float[Array, ""]
    """Norm of the candidate's step, including refined points."""

    parameter_norm: Float[Array, ""]
    """Norm of the parameters before the step."""

    cg_iterations: Int[Array, ""]
    """Iterations of conjugate gradients; 0 for a factorisation."""

    forcing: Float[Array, ""]
    """Forcing term of conjugate gradients; 0 for an exact solve."""

    step_fraction: Float[Array, ""]
    """Length of the candidate's step over the full step; below 1 after backtracking."""

    damping_fraction: Float[Array, ""]
    """`d.D d / d.(H + D) d`: 0 for Gauss-Newton, 1 for gradient descent."""

    weightless: Bool[Array, ""]
    """Whether the robust loss gave weight to no observation, so that there was no step to take."""

    repairs: Int[Array, ""]
    """Number of camera rounds, backtracking trials and pattern moves after the first candidate."""

    @classmethod
    def stacked(cls, steps: Sequence[StepInfo]) -> StepInfo:
        """The records of several iterations as one, of NumPy arrays."""

        def column(name):
            return np.array([getattr(step, name) for step in steps], KINDS.get(name, float))

        columns: dict[str, Any] = {name: column(name) for name in cls._fields}
        return cls(**columns)

    __eq__, __ne__, __repr__, __hash__ = same, differ, outline, None  # pyright: ignore[reportAssignmentType]


KINDS: dict[str, Any] = {
    "accepted": bool,
    "weightless": bool,
    "cg_iterations": np.int32,
    "repairs": np.int32,
}
"""Types of the fields of a record that are no floating point numbers."""
