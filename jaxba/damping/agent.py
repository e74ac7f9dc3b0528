"""The agent's side of an iteration: what it sees, and what its action means.

The game and the learned policy share this, so that a policy meets in a solve exactly what it met in training: the same
observation, the same map from an action in (-1, 1) to lambda, the same guard around it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Any, Literal, NamedTuple, get_args

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping.policy import ProblemInfo
from jaxba.damping.rules import LARGEST, Ceres
from jaxba.linear.step import Effort
from jaxba.lm.records import StepInfo
from jaxba.problem.options import LensStep, PointStarts, Refinement, StepOptions
from jaxba.refinement.trial import SHORTER

Observation = Literal["scale-free", "paper", "released-code", "duration"]
ActionMode = Literal["absolute", "relative"]
GuardMode = Literal["off", "pause", "hand-over"]
EffortMode = Literal["fixed", "points", "points+forcing"]

FLOOR = 1e-9
"""Smallest relative decrease that a feature tells from none."""

PAPER_LIMIT = 1000.0
"""Upper end of the paper's observation range, (-inf, 1000]. Source: Belder et al. 2023."""

RELATIVE_REACH = 3.0
"""Decades by which a relative action changes lambda at most."""

FORCING = (-3.0, -0.3)
"""log10 of the forcing terms that a third number of an action ranges over: from DeepLM's to half."""

IDLE_SHARE = 0.1
"""Share of damping in the curvature of an inexact step, relative to the forcing term, below which a smaller lambda is
taken to change nothing but the length of conjugate gradients (docs/game-tried.md)."""

LARGEST_ESCALATION = 12.0
"""Decades; more than the whole range of lambda means nothing."""

FIRST_DAMPING = -4.0
"""log10 of the lambda that a first relative action starts from, with twice the reach. Source: Ceres' first lambda."""


@dataclass(frozen=True)
class AgentConfig:
    """How an agent is wired to the solver. Hashable; stored in a policy's file."""

    observation: Observation = "scale-free"
    """`scale-free`: decreases, gain ratios and lambdas of the last steps as ratios and logarithms. `paper`: the last
    errors. `released-code`: the decrease that the linear model promised, as in the authors' code. `duration`: minus the
    time of each of the last iterations, which by the game's deterministic clock is one (the paper's reversed roles)."""

    history: int = 5
    """Steps that an observation goes back; the paper's state size."""

    low: float = -9.0
    """log10 of the smallest lambda."""

    high: float = 2.0
    """log10 of the largest lambda."""

    first_low: float = -5.0
    """log10 of the smallest first lambda, where nothing is known of the problem yet."""

    descent: float = 1.5
    """Decades by which lambda may fall from one iteration to the next. Without this and the last limit a policy jumped
    between 10 and 1e-7 and ended 6% above the best on Ladybug-49; with a floor of 1e-6 instead, flat valleys of the
    held-out scenes were never crossed."""

    min_gain: float = 0.25
    """Gain ratio that a candidate must exceed: a step that does less than that of what the linear model promised is
    tried again shorter. Source: the sufficient decrease of trust regions (Nocedal, Wright 2006, algorithm 4.1)."""

    action: ActionMode = "absolute"
    """`absolute`: an action is a lambda, linear in its logarithm. `relative`: it is a factor on the last one."""

    guard: GuardMode = "hand-over"
    """`off`: nothing is done to the agent's choices. Otherwise, after `patience` rejections in a row, Ceres' rule
    decides: until a step is accepted (`pause`), or to the end (`hand-over`). It starts at the last lambda that worked,
    or at its own first one where twice the refused lambda is larger."""

    patience: int = 2
    """Rejections in a row that call the guard."""

    max_rejections: int = 8
    """Rejections in a solve after which the guard decides to the end, in either mode."""

    escalate: float = 0.5
    """Decades by which lambda must rise at least after a rejection, and after an accepted step for each time that it
    had to be shortened; 0 switches it off, as does guard `off`."""

    refine_points: int = 3
    """Embedded point iterations of the step that it drives."""

    trials: int = 4
    """Trials of the step that it drives, see `StepOptions`."""

    camera_rounds: int = 3
    """Camera rounds of the step that it drives, see `StepOptions`."""

    pattern_moves: int = 1
    """Pattern moves of the step that it drives, see `StepOptions`."""

    camera_damping: float = 1.0
    """Damping of the cameras relative to that of the points in the step that it drives, see `StepOptions`."""

    lens_step: LensStep = "pixels"
    """How the step that it drives is added to a lens, see `StepOptions`."""

    point_starts: PointStarts = "rays"
    """Where embedded point iterations start in the step that it drives, see `StepOptions`."""

    remembered_steps: int = 3
    """Earlier steps that take part in the step that it drives, where its method has a use for them."""

    effort: EffortMode = "fixed"
    """What an action decides beside lambda: nothing, or with a second number how many of the point iterations a step
    has, and with a third the forcing term of conjugate gradients. The guard's rule has all of them, and the smallest
    forcing term."""

    def __post_init__(self) -> None:
        for name, known in (
            ("observation", Observation),
            ("action", ActionMode),
            ("guard", GuardMode),
            ("effort", EffortMode),
        ):
            if getattr(self, name) not in get_args(known):
                raise ValueError(f"{name} must be one of {', '.join(get_args(known))}, not {getattr(self, name)!r}")
        if not 1 <= self.history <= 20:
            raise ValueError(f"history must be 1 to 20, is {self.history}")
        if not -15 <= self.low < self.high <= 10:
            raise ValueError(f"lambda must range over decades within -15 to 10, not {self.low} to {self.high}")
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
        if self.effort != "fixed" and not self.refine_points:
            raise ValueError(f"effort {self.effort!r} needs embedded point iterations to choose from: refine_points")
        self.step_options(StepOptions())

    def step_options(self, options: StepOptions) -> StepOptions:
        """The options with the embedded iterations and the coordinates of damping and lenses that the agent was trained
        with."""
        return replace(
            options,
            refinement=Refinement(
                points=self.refine_points,
                starts=self.point_starts,
                trials=self.trials,
                camera_rounds=self.camera_rounds,
                pattern_moves=self.pattern_moves,
                previous_steps=self.remembered_steps,
            ),
            coordinates=replace(options.coordinates, camera_damping=self.camera_damping, lens_step=self.lens_step),
        )

    @property
    def guarded(self) -> bool:
        """Whether anything is done to the agent's choices."""
        return self.guard != "off"

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return 1 + get_args(EffortMode).index(self.effort)

    @property
    def observation_size(self) -> int:
        """Numbers in an observation."""
        if self.observation == "scale-free":
            return len(StepFacts._fields) * self.history + len(_GLOBALS) + self.action_size - 1
        return self.history


BEFORE = {"lens_step": "file", "point_starts": "step", "remembered_steps": 0, "pattern_moves": 0}
"""What a policy file means that is older than these settings."""


def config_from(values: dict[str, Any]) -> AgentConfig:
    """The inverse of `dataclasses.asdict`.

    Raises:
        ValueError: unknown names or impossible values.
    """
    known = {field.name: field for field in fields(AgentConfig)}
    values = {**BEFORE, **values}
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"unknown setting {name!r}")
        kind = type(known[name].default)
        if not isinstance(value, (int, float) if kind is float else kind) or isinstance(value, bool):
            raise ValueError(f"{name} must be of type {kind.__name__}, is {value!r}")
    return AgentConfig(**values)


class StepFacts(NamedTuple):
    """Features of one step, all within [-2, 2]."""

    present: Array  # 0 where there was no such step yet
    decrease: Array  # log10 of cost before over cost after
    small_decrease: Array  # log10 of the relative decrease, for the last digits
    promised: Array  # log10 of the decrease that the linear model promised, relative to the cost
    gain: Array  # gain ratio, squashed
    candidate: Array  # log10 of the candidate's cost over the cost, for rejected steps
    damping: Array  # log10 of lambda
    accepted: Array
    damping_share: Array  # share of the step's curvature that was damping's
    shortened: Array  # how often the step was shortened


_GLOBALS = (
    "progress",  # log10 of the first cost over the present one
    "error_angle",  # log10 of the rms error over the focal length
    "tracks",  # observations per point
    "redundancy",  # equations per unknown
    "cameras",
    "rejections",  # in a row
    "all_rejections",
    "remaining",  # share of the budget, which makes its end foreseeable
    "worked",  # log10 of the last lambda that was accepted
    "smallest_worked",  # log10 of the smallest one
    "failed",  # log10 of the largest lambda rejected since
)


class Memory(NamedTuple):
    """What is kept between iterations."""

    info: ProblemInfo
    facts: Float[Array, "history features"]  # newest first
    errors: Float[Array, " history"]  # what observations other than `scale-free` are made of, newest first
    cost: Float[Array, ""]
    damping: Float[Array, ""]  # log10 of the last lambda
    iteration: Int[Array, ""]
    row: Int[Array, ""]  # rejections in a row
    rejections: Int[Array, ""]  # in all
    worked: Float[Array, ""]
    smallest_worked: Float[Array, ""]
    failed: Float[Array, ""]
    growth: Float[Array, ""]  # of the guard's rule after the next rejection
    gain: Float[Array, ""]  # of the last step
    shortened: Float[Array, ""]  # how often the last step was shortened
    hand_over: Bool[Array, ""]  # the guard decides to the end
    capped: Bool[Array, ""]  # the last step was short because of its lambda, and of nothing else
    idle: Bool[Array, ""]  # the last step was left inexact by more than what lambda did to it
    effort: Effort | None  # of the last step, once it is chosen; None where it is fixed


def begin(config: AgentConfig, info: ProblemInfo) -> Memory:
    """Before the first iteration."""
    dtype = info.cost.dtype
    number = lambda x: jnp.asarray(x, dtype)
    zero = jnp.zeros((), jnp.int32)
    no = jnp.zeros((), bool)
    error = jnp.minimum(_error(info, info.cost), PAPER_LIMIT) if config.observation == "paper" else number(0.0)
    return Memory(
        info=info,
        facts=jnp.zeros((config.history, len(StepFacts._fields)), dtype),
        errors=jnp.zeros((config.history,), dtype).at[0].set(error),
        cost=info.cost,
        damping=number(FIRST_DAMPING),
        iteration=zero,
        row=zero,
        rejections=zero,
        worked=number(FIRST_DAMPING),
        smallest_worked=number(FIRST_DAMPING),
        failed=number(config.low),
        growth=number(Ceres().reject_growth),
        gain=number(0.0),
        shortened=number(0.0),
        hand_over=no,
        capped=no,
        idle=no,
        effort=None if config.effort == "fixed" else _full_effort(config, dtype),
    )


def observe(config: AgentConfig, memory: Memory) -> Float[Array, " features"]:
    """What the network sees, float32."""
    if config.observation != "scale-free":
        return memory.errors.astype(jnp.float32)
    info = memory.info
    unknowns = 9.0 * info.cameras + 3.0 * info.points
    whole = [
        _log(info.cost / memory.cost) / 3,
        _log(_error(info, memory.cost) / info.focal) + 3,
        _log(info.observations / info.points),
        _log(2.0 * info.observations / unknowns),
        _log(info.cameras) - 1,
        memory.row / 3.0,
        memory.rejections / 5.0,
        1 - memory.iteration / info.max_iterations,
        _decades(memory.worked),
        _decades(memory.smallest_worked),
        _decades(memory.failed),
    ]
    if memory.effort is not None:
        points, forcing = memory.effort
        whole += [points / config.refine_points, *([] if forcing is None else [_log(forcing) + 1])]
    features = jnp.concatenate([memory.facts.reshape(-1), jnp.stack([jnp.asarray(x) for x in whole])])
    return jnp.clip(jnp.nan_to_num(features), -2, 2).astype(jnp.float32)


def _scale(config: AgentConfig, memory: Memory) -> tuple[Any, Any]:
    """log10 of the lambda that the action 0 means, and how many decades the action 1 lies above it."""
    if config.action == "absolute":
        return 0.5 * (config.low + config.high), 0.5 * (config.high - config.low)
    return memory.damping, jnp.where(memory.iteration == 0, 2 * RELATIVE_REACH, RELATIVE_REACH)


def action_of(config: AgentConfig, memory: Memory, decades: Float[Array, ""]) -> Float[Array, ""]:
    """The action that asks for a lambda of `10**decades`; beyond (-1, 1) where no action does."""
    middle, half = _scale(config, memory)
    return (decades - middle) / half


def damping_of(config: AgentConfig, memory: Memory, action: Float[Array, ""]) -> Float[Array, ""]:
    """Lambda for an action in (-1, 1), the guard's word included."""
    middle, half = _scale(config, memory)
    least = _least(config, memory.cost.dtype)
    wanted = jnp.clip(middle + half * action.astype(memory.cost.dtype), least, config.high)
    if not config.guarded:
        return 10**wanted
    lowest = jnp.where(memory.iteration == 0, config.first_low, memory.damping - config.descent)
    wanted = jnp.maximum(wanted, jnp.where(memory.idle, memory.damping, lowest))
    rejected = memory.row > 0
    too_bold = rejected | (memory.shortened > 0)
    rise = config.escalate * jnp.where(rejected, 1.0, memory.shortened)
    wanted = jnp.where(too_bold, jnp.maximum(wanted, memory.damping + rise), wanted)
    wanted = jnp.where(memory.capped, jnp.minimum(wanted, memory.damping - 1), wanted)
    shrink = Ceres().after_success(memory.gain)
    guard = memory.damping + jnp.log10(jnp.where(rejected, memory.growth, shrink))
    # a rescue starts at the last lambda that worked, or at the rule's own first one where twice the refused one is
    # larger; so does a later one, when the rule in charge is refused as often in a row
    rescue = jnp.where(memory.worked > guard, memory.worked, FIRST_DAMPING)
    guard = jnp.where(memory.row == config.patience, jnp.maximum(guard, rescue), guard)
    return jnp.clip(10 ** jnp.where(_guarding(config, memory), guard, wanted), 10**least, LARGEST)


def _least(config: AgentConfig, dtype: Any) -> float:
    """log10 of the smallest lambda: what is below the rounding unit is lost when it is added to a diagonal.

    In float64 that is beyond every agent's reach. In float32 `learned` went to 1e-9, where systems of real problems
    have no digit left and steps are refused, or accepted a quarter as long (docs/performance.md).
    """
    return max(config.low, math.log10(float(jnp.finfo(dtype).eps)))


def _guarding(config: AgentConfig, memory: Memory) -> Bool[Array, ""]:
    """Whether Ceres' rule chooses lambda, if there is a guard."""
    return memory.hand_over | (memory.row >= config.patience)


def _full_effort(config: AgentConfig, dtype: Any) -> Effort:
    forcing = jnp.asarray(10 ** FORCING[0], dtype) if config.effort == "points+forcing" else None
    return Effort(jnp.asarray(config.refine_points, jnp.int32), forcing)


def with_effort(config: AgentConfig, memory: Memory, action: Float[Array, " actions"]) -> Memory:
    """Memory with the effort that an action decides, if it decides any."""
    if memory.effort is None:
        return memory
    full = _full_effort(config, memory.cost.dtype)
    share = 0.5 + 0.5 * action.astype(memory.cost.dtype)
    chosen = Effort(jnp.round(share[1] * config.refine_points).astype(jnp.int32), None)
    if config.effort == "points+forcing":
        low, high = FORCING
        chosen = chosen._replace(forcing=10 ** (low + (high - low) * share[2]))
    guarded = _guarding(config, memory) & config.guarded
    return memory._replace(effort=jax.tree.map(lambda all_, some: jnp.where(guarded, all_, some), full, chosen))


def record(config: AgentConfig, memory: Memory, step: StepInfo) -> Memory:
    """After an iteration."""
    dtype = memory.cost.dtype
    damping = jnp.log10(step.damping)
    decrease = (step.previous_cost - step.cost) / step.previous_cost
    tiny = lambda x: (_log(x + FLOOR) + 4.5) / 4.5
    gain = jnp.where(jnp.isfinite(step.gain_ratio), step.gain_ratio, -1.0)
    shortened = jnp.round(-jnp.log(step.share) / -math.log(SHORTER))
    facts = StepFacts(
        present=jnp.ones((), dtype),
        decrease=_log(step.previous_cost / step.cost),
        small_decrease=tiny(decrease),
        promised=tiny(step.predicted / step.previous_cost),
        gain=gain / (1 + jnp.abs(gain)),
        candidate=jnp.where(step.accepted, 0.0, _log(step.candidate_cost / step.previous_cost)),
        damping=_decades(damping),
        accepted=jnp.where(step.accepted, 1.0, -1.0),
        damping_share=step.damping_share,
        shortened=shortened / 2,
    )
    row = jnp.clip(jnp.nan_to_num(jnp.stack(facts), nan=2.0), -2, 2).astype(dtype)
    error = {
        "paper": lambda: jnp.minimum(_error(memory.info, step.cost), PAPER_LIMIT),
        "released-code": lambda: jnp.nan_to_num(step.predicted),
        "duration": lambda: -jnp.ones((), dtype),
        "scale-free": lambda: jnp.zeros((), dtype),
    }[config.observation]()
    shifted = lambda old, new: jnp.concatenate([new[None].astype(dtype), old[:-1]])
    in_row = jnp.where(step.accepted, 0, memory.row + 1).astype(jnp.int32)
    rejections = (memory.rejections + ~step.accepted).astype(jnp.int32)
    over = rejections >= config.max_rejections
    if config.guard == "hand-over":
        over = over | (in_row >= config.patience)
    guarding = _guarding(config, memory)
    growth = jnp.where(guarding, 2 * memory.growth, Ceres().reject_growth)
    growth = jnp.where(step.accepted, 0.5 * Ceres().reject_growth, growth).astype(dtype)
    pick = lambda yes, no: jnp.where(step.accepted, yes, no).astype(dtype)
    return Memory(
        info=memory.info,
        facts=shifted(memory.facts, row),
        errors=shifted(memory.errors, error),
        cost=step.cost,
        damping=damping.astype(dtype),
        iteration=(memory.iteration + 1).astype(jnp.int32),
        row=in_row,
        rejections=rejections,
        worked=pick(damping, memory.worked),
        smallest_worked=pick(jnp.minimum(damping, memory.smallest_worked), memory.smallest_worked),
        failed=pick(config.low, jnp.maximum(damping, memory.failed)),
        growth=growth,
        gain=gain.astype(dtype),
        shortened=shortened.astype(dtype),
        hand_over=memory.hand_over | over,
        effort=memory.effort,
        idle=step.accepted & (step.damping_share < IDLE_SHARE * step.forcing),
        capped=step.accepted & (step.share == 1) & (decrease < HEAVY_DECREASE) & (step.damping_share > HEAVY_SHARE),
    )


HEAVY_DECREASE, HEAVY_SHARE = 1e-2, 0.5
"""A whole step that lowers the cost by less, and is short for damping more than this share, must be followed by a
lambda ten times smaller: else a solve could stand still without having converged. Not one that had to be shortened: in
a narrow valley (bulani7) a smaller lambda still was refused twice, and the guard took over in iteration 8."""


def _log(x: Any) -> Array:
    return jnp.log10(jnp.maximum(x, 1e-30))


def _decades(x: Array) -> Array:
    return (x + 4) / 6


def _error(info: ProblemInfo, cost: Array) -> Array:
    """Root mean square error of an observation in pixels."""
    return jnp.sqrt(2 * cost / info.observations)
