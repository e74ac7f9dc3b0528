"""Hand-written damping rules. What lambda multiplies is `Coordinates.scaling`.

Formulas and sources are in the docstring of each class."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping.policy import ProblemInfo
from jaxba.lm.records import StepInfo
from jaxba.typing import register_pytree

LARGEST = 1e32  # upper bound of every lambda. Source: Ceres' smallest trust-region radius 1e-32
# lower bound of rules whose source has none, or zero: a lambda of exactly zero could never grow
# again
SMALLEST = 1e-30


def _scalar(value: Any, info: ProblemInfo) -> Array:
    return jnp.asarray(value, info.cost.dtype)


@register_pytree
@dataclass(frozen=True)
class Ceres:
    """Ceres' trust-region rule with radius 1 / lambda.

    Accepted with gain `rho`: lambda times `clip(1 - (2 rho - 1)^3, 1/3, upper)`; rejected: times 2,
    4, 8 ...
    Source: Ceres levenberg_marquardt_strategy.cc (after Madsen, Nielsen, Tingleff 2004, section
    3.2)."""

    initial: float = 1e-4
    """First lambda. Source: Ceres initial_trust_region_radius 1e4."""

    shrink_floor: float = 1 / 3
    """Smallest factor after an accepted step."""

    shrink_ceiling: float = 2.0
    """Largest factor after an accepted step; the formula's own supremum for positive gains."""

    reject_growth: float = 2.0
    """First factor after a rejection; doubles with each further one."""

    minimum: float = 1e-16
    """Smallest lambda. Source: Ceres max_trust_region_radius 1e16."""

    min_gain: float = 1e-3
    """Source: Ceres min_relative_decrease."""

    relative: float = 0.0
    """1 where `initial` counts in units of the largest Hessian entry under identity scaling
    (g2o)."""

    def factor(
        self, accepted: Bool[Array, ""], gain: Float[Array, ""], growth: Float[Array, ""]
    ) -> Float[Array, ""]:
        """Factor on lambda after a step with this gain ratio, or after a rejected one, whose factor
        is `growth`."""
        return jnp.where(
            accepted,
            jnp.clip(1 - (2 * gain - 1) ** 3, self.shrink_floor, self.shrink_ceiling),
            growth,
        )

    def init(self, info: ProblemInfo) -> tuple[Array, Array]:
        """See `DampingPolicy`. The state is the factor after the next rejection."""
        damping = _scalar(self.initial * (1 + self.relative * (info.unit - 1)), info)
        return _scalar(self.reject_growth, info), damping

    def propose(self, state: Float[Array, ""], step: StepInfo) -> tuple[Array, Array]:
        """See `DampingPolicy`."""
        factor = self.factor(step.accepted, step.gain_ratio, state)
        growth = jnp.where(step.accepted, self.reject_growth, 2 * state).astype(state.dtype)
        return growth, jnp.clip(step.damping * factor, self.minimum, LARGEST).astype(state.dtype)


def nielsen() -> Ceres:
    """g2o's rule: as Ceres', but an accepted step always shrinks lambda (factor in [1/3, 2/3]).

    Source: g2o optimization_algorithm_levenberg.cpp: first lambda 1e-5 times the largest Hessian
    diagonal, which under diagonal scaling is 1e-5 itself; any decrease is accepted."""
    return Ceres(initial=1e-5, shrink_ceiling=2 / 3, min_gain=0.0, minimum=SMALLEST, relative=1.0)


@register_pytree
@dataclass(frozen=True)
class Geometric:
    """Multiply by a constant after success, by another otherwise."""

    initial: float
    """First lambda."""

    success: float
    """Factor after an accepted step."""

    failure: float
    """Factor after a rejected step."""

    minimum: float
    """Smallest lambda."""

    maximum: float
    """Largest lambda."""

    min_gain: float = 0.0
    """A step with a smaller gain ratio is rejected."""

    good_gain: float = -math.inf
    """Gain ratio above which an accepted step counts as a success."""

    def init(self, info: ProblemInfo) -> tuple[tuple[()], Array]:
        """See `DampingPolicy`."""
        return (), _scalar(self.initial, info)

    def propose(self, state: tuple[()], step: StepInfo) -> tuple[tuple[()], Array]:
        """See `DampingPolicy`."""
        good = step.accepted & (step.gain_ratio > self.good_gain)
        damping = step.damping * jnp.where(good, self.success, self.failure)
        return (), jnp.clip(damping, self.minimum, self.maximum).astype(step.damping.dtype)


@register_pytree
@dataclass(frozen=True)
class Classic(Geometric):
    """The paper's baseline: halve after a good step, double otherwise.

    Source: Belder et al. 2023, implementation details (first lambda 1/4); directions and the gain
    threshold 0.4 as in the authors' released code, since the printed text swaps them. A step that
    lowers the cost is always accepted."""

    initial: float = 0.25
    success: float = 0.5
    failure: float = 2.0
    minimum: float = 0.0
    maximum: float = LARGEST
    good_gain: float = 0.4


def gtsam() -> Geometric:
    """GTSAM's legacy rule: divide by 10, multiply by 10, lambda in [0, 1e5]. Source:
    LevenbergMarquardtParams."""
    return Geometric(initial=1e-5, success=0.1, failure=10.0, minimum=SMALLEST, maximum=1e5)


def stba() -> Geometric:
    """STBA's rule: divide by 3, multiply by 3. Source: Zhou et al. 2020, authors' main branch
    (radius 1e4)."""
    return Geometric(initial=1e-4, success=1 / 3, failure=3.0, minimum=SMALLEST, maximum=LARGEST)


def theseus() -> Geometric:
    """Theseus' adaptive rule: divide by 9, multiply by 11, lambda in [1e-7, 1e7]; accepts gains
    above 0.1."""
    return Geometric(
        initial=1e-3, success=1 / 9, failure=11.0, minimum=1e-7, maximum=1e7, min_gain=0.1
    )


@register_pytree
@dataclass(frozen=True)
class Schedule:
    """Repeats a list of lambdas whatever happens; a list of one is a constant.

    Source of the default: Belder et al. 2023, constant scheduler, the average of the authors'
    agent."""

    values: tuple[float, ...] = (1e-15, 1e-15, 0.194, 0.551)
    """Lambdas, in order."""

    min_gain: float = 0.0
    """Any decrease is accepted."""

    def init(self, info: ProblemInfo) -> tuple[Int[Array, ""], Array]:
        """See `DampingPolicy`."""
        return jnp.zeros((), jnp.int32), _scalar(self.values[0], info)

    def propose(self, state: Int[Array, ""], step: StepInfo) -> tuple[Array, Array]:
        """See `DampingPolicy`."""
        after = (state + 1) % len(self.values)
        return after, jnp.asarray(self.values, step.damping.dtype)[after]


def gauss_newton() -> Schedule:
    """Next to no damping. The seven gauge freedoms make the undamped system singular, so lambda is
    1e-10.

    Under diagonal scaling this changes no direction that the observations determine by more than
    1e-10."""
    return Schedule(values=(1e-10,))
