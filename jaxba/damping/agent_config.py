"""How an agent is connected to the solver: what it observes, what its actions mean, and the step
that it drives."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

from jaxba.problem.options import EMBEDDED, LensStep, Refinement, StepOptions, check_known

Observation = Literal["scale-free", "paper", "duration"]
GuardMode = Literal["off", "hand-over"]

# decades; more than the whole range of lambda would have no further effect
LARGEST_ESCALATION = 12.0


@dataclass(frozen=True)
class AgentConfig:
    """How an agent is connected to the solver. Hashable; stored in a policy's file."""

    observation: Observation = "scale-free"
    """`scale-free`: decreases, gain ratios and lambdas of the last steps as ratios and logarithms.
    `paper`: the last errors. `duration`: minus the duration of each of the last iterations by the
    game's clock (`features.duration`; the paper's reversed roles of state and reward)."""

    history: int = 5
    """Number of past steps in an observation. Source of the default: the paper's state size."""

    low: float = -9.0
    """log10 of the smallest lambda."""

    high: float = 2.0
    """log10 of the largest lambda."""

    first_low: float = -5.0
    """log10 of the smallest lambda of the first iteration, when nothing is known about the problem
    yet."""

    descent: float = 1.5
    """Decades by which lambda may fall from one iteration to the next. Without this limit and
    `first_low` a policy alternated between 10 and 1e-7 and ended 6% above the best cost of
    Ladybug-49. With a floor of 1e-6 instead, flat valleys of the held-out scenes were never
    crossed."""

    min_gain: float = 0.0
    """Gain ratio that a candidate must exceed; 0 accepts any decrease."""

    guard: GuardMode = "hand-over"
    """`off`: the agent's lambdas are used as they are. `hand-over`: they are limited
    (`damping/guard.py`), and after `patience` rejections in a row Ceres' rule chooses lambda to the
    end of the solve."""

    patience: int = 2
    """Rejections in a row after which Ceres' rule takes over."""

    max_rejections: int = 8
    """Rejections in all after which Ceres' rule takes over."""

    escalate: float = 0.5
    """Decades by which lambda rises at least after a rejection, and after an accepted step for each
    time that it was shortened. Without effect if it is 0 or the guard is off."""

    refinement: Refinement = field(default_factory=Refinement)
    """Embedded iterations of the step."""

    lens_step: LensStep = "file"
    """How a step is added to focal length and distortion, `Coordinates.lens_step`."""

    def __post_init__(self) -> None:
        check_known("observation", self.observation, Observation)
        check_known("guard", self.guard, GuardMode)
        if not 1 <= self.history <= 20:
            raise ValueError(f"history must be 1 to 20, is {self.history}")
        if not -15 <= self.low < self.high <= 10:
            raise ValueError(
                f"lambda must range over decades within -15 to 10, not {self.low} to {self.high}"
            )
        if self.patience < 1 or self.max_rejections < 1:
            raise ValueError("patience and max_rejections must be at least 1")
        if not 0 <= self.min_gain < 1:
            raise ValueError(f"min_gain must be at least 0 and below 1, is {self.min_gain}")
        if not self.first_low <= self.high:
            raise ValueError(f"first_low must be at most high, {self.high}, is {self.first_low}")
        if not self.descent > 0:
            raise ValueError(f"descent must be positive, is {self.descent}")
        if not 0 <= self.escalate <= LARGEST_ESCALATION:
            raise ValueError(f"escalate must be 0 to {LARGEST_ESCALATION:g}, is {self.escalate}")
        self.step_options(StepOptions())

    def step_options(self, options: StepOptions) -> StepOptions:
        """The options with this configuration's embedded iterations and lens coordinates."""
        coordinates = replace(options.coordinates, lens_step=self.lens_step)
        return replace(options, refinement=self.refinement, coordinates=coordinates)


def embedded() -> AgentConfig:
    """An agent whose step has all embedded iterations, and distortion stepped per pixel. Candidates
    without sufficient decrease (Nocedal, Wright 2006, algorithm 4.1) are shortened and tried
    again."""
    return AgentConfig(min_gain=0.25, refinement=EMBEDDED, lens_step="pixels")
