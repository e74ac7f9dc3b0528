"""What an agent observes: features of the last steps and of the solve.

The game and the policies share this, so that a policy observes the same in a solve as in
training."""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float, Int

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.default_policy import FIRST_DAMPING, finite_gain, times_shortened
from jaxba.damping.guard import GuardState, initial_guard, update_guard
from jaxba.damping.policy import ProblemInfo
from jaxba.lm.records import StepInfo

FLOOR = 1e-9  # smallest relative decrease that a feature distinguishes from zero
# upper end of the paper's observation range, (-inf, 1000]. Source: Belder et al. 2023
PAPER_LIMIT = 1000.0
FEATURE_LIMIT = 2.0  # bound of the absolute value of every scale-free feature


# fmt: off
DURATIONS = (
    0.769, 0.808, 0.867, 0.882, 0.890, 0.897, 0.904, 0.912, 0.921, 0.930,
    0.944, 0.964, 0.989, 1.008, 1.033, 1.069, 1.103, 1.169, 1.268, 1.673,
)
# fmt: on
"""Quantiles (2.5%, 7.5%, ...) of the duration of an iteration over its mean. Measured once:
processor time of 2,900 compiled plain steps on a scene of 10 cameras and 10 points with known
lenses, two x86-64 cores, mean 0.22 ms."""


class StepFeatures(NamedTuple):
    """Features of one step, all within [-2, 2]."""

    present: Array  # 0 if there was no such step yet, else 1
    decrease: Array  # log10 of cost before over cost after
    small_decrease: Array  # log10 of the relative decrease, scaled
    promised: Array  # log10 of the linear model's decrease relative to the cost, scaled
    gain: Array  # gain ratio, squashed
    candidate: Array  # log10 of the candidate's cost over the cost, for rejected steps
    damping: Array  # log10 of lambda, scaled
    accepted: Array  # 1 or -1
    damping_fraction: Array  # damping's share of the step's curvature
    shortened: Array  # how often the step was shortened


SOLVE_FEATURES = (
    "progress",  # log10 of the first cost over the current one
    "error_angle",  # log10 of the rms error over the focal length
    "tracks",  # observations per point
    "redundancy",  # equations per unknown
    "cameras",
    "consecutive_rejections",
    "rejections",  # in all
    "remaining",  # fraction of the iteration budget that is left
    "accepted_damping",  # log10 of the last accepted lambda
    "smallest_accepted",  # log10 of the smallest accepted lambda
    "largest_rejected",  # log10 of the largest lambda rejected since the last accepted step
)
"""Features of the solve, in order."""


class Memory(NamedTuple):
    """State of an agent between iterations."""

    info: ProblemInfo
    iteration: Int[Array, ""]  # number of the next iteration, from 0
    damping: Float[Array, ""]  # log10 of the last lambda
    gain: Float[Array, ""]  # gain ratio of the last step, -1 if not finite
    steps: Float[Array, "history features"]  # `StepFeatures` of the last steps, newest first
    # the observation itself, unless it is `scale-free`; newest first
    errors: Float[Array, " history"]
    cost: Float[Array, ""]
    smallest_accepted: Float[Array, ""]
    largest_rejected: Float[Array, ""]
    guard: GuardState


def observation_size(config: AgentConfig) -> int:
    """Numbers in an observation."""
    if config.observation == "scale-free":
        return len(StepFeatures._fields) * config.history + len(SOLVE_FEATURES)
    return config.history


def begin(config: AgentConfig, info: ProblemInfo) -> Memory:
    """Before the first iteration."""
    dtype = info.cost.dtype

    def number(x):
        return jnp.asarray(x, dtype)

    error = (
        jnp.minimum(_rms_error(info, info.cost), PAPER_LIMIT)
        if config.observation == "paper"
        else number(0.0)
    )
    return Memory(
        info=info,
        iteration=jnp.zeros((), jnp.int32),
        damping=number(FIRST_DAMPING),
        gain=number(0.0),
        steps=jnp.zeros((config.history, len(StepFeatures._fields)), dtype),
        errors=jnp.zeros((config.history,), dtype).at[0].set(error),
        cost=info.cost,
        smallest_accepted=number(FIRST_DAMPING),
        largest_rejected=number(config.low),
        guard=initial_guard(config, dtype),
    )


def observe(config: AgentConfig, memory: Memory) -> Float[Array, " features"]:
    """What the network sees, float32."""
    if config.observation != "scale-free":
        return memory.errors.astype(jnp.float32)
    info = memory.info
    rescue = memory.guard.rescue
    unknowns = 9.0 * info.cameras + 3.0 * info.points
    solve = [
        _log(info.cost / memory.cost) / 3,
        _log(_rms_error(info, memory.cost) / info.focal) + 3,
        _log(info.observations / info.points),
        _log(2.0 * info.observations / unknowns),
        _log(info.cameras) - 1,
        rescue.in_a_row / 3.0,
        rescue.rejections / 5.0,
        1 - memory.iteration / info.max_iterations,
        _scaled_decades(rescue.worked),
        _scaled_decades(memory.smallest_accepted),
        _scaled_decades(memory.largest_rejected),
    ]
    features = jnp.concatenate(
        [memory.steps.reshape(-1), jnp.stack([jnp.asarray(x) for x in solve])]
    )
    return jnp.clip(jnp.nan_to_num(features), -FEATURE_LIMIT, FEATURE_LIMIT).astype(jnp.float32)


def record(config: AgentConfig, memory: Memory, step: StepInfo) -> Memory:
    """After an iteration."""
    dtype = memory.cost.dtype
    damping = jnp.log10(step.damping).astype(dtype)
    gain = finite_gain(step).astype(dtype)
    decrease = (step.previous_cost - step.cost) / step.previous_cost

    def scaled(x):
        return (_log(x + FLOOR) + 4.5) / 4.5

    features = StepFeatures(
        present=jnp.ones((), dtype),
        decrease=_log(step.previous_cost / step.cost),
        small_decrease=scaled(decrease),
        promised=scaled(step.predicted / step.previous_cost),
        gain=gain / (1 + jnp.abs(gain)),
        candidate=jnp.where(step.accepted, 0.0, _log(step.candidate_cost / step.previous_cost)),
        damping=_scaled_decades(damping),
        accepted=jnp.where(step.accepted, 1.0, -1.0),
        damping_fraction=step.damping_fraction,
        shortened=times_shortened(step) / 2,
    )
    row = jnp.nan_to_num(jnp.stack(features), nan=FEATURE_LIMIT)
    row = jnp.clip(row, -FEATURE_LIMIT, FEATURE_LIMIT).astype(dtype)
    error = {
        "paper": lambda: jnp.minimum(_rms_error(memory.info, step.cost), PAPER_LIMIT),
        "duration": lambda: -duration(step),
        "scale-free": lambda: jnp.zeros((), dtype),
    }[config.observation]()

    def shifted(old, new):
        return jnp.concatenate([new[None].astype(dtype), old[:-1]])

    def pick(if_accepted, if_rejected):
        return jnp.where(step.accepted, if_accepted, if_rejected).astype(dtype)

    return Memory(
        info=memory.info,
        iteration=(memory.iteration + 1).astype(jnp.int32),
        damping=damping,
        gain=gain,
        steps=shifted(memory.steps, row),
        errors=shifted(memory.errors, error),
        cost=step.cost,
        smallest_accepted=pick(
            jnp.minimum(damping, memory.smallest_accepted), memory.smallest_accepted
        ),
        largest_rejected=pick(config.low, jnp.maximum(damping, memory.largest_rejected)),
        guard=update_guard(config, memory.guard, step),
    )


def duration(step: StepInfo) -> Float[Array, ""]:
    """Duration of an iteration by the game's clock over the mean: one of `DURATIONS`, as it has
    none of its own.

    Bits of the candidate's cost and of lambda draw it: reward and observation agree, and a solve
    repeats."""
    bits = [
        lax.bitcast_convert_type(x.astype(jnp.float32), jnp.uint32)
        for x in (step.candidate_cost, step.damping)
    ]
    key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), bits[0]), bits[1])
    choices = jnp.asarray(DURATIONS, step.cost.dtype)
    return choices[jax.random.randint(key, (), 0, len(DURATIONS))]


def _log(x: Any) -> Array:
    return jnp.log10(jnp.maximum(x, 1e-30))


def _scaled_decades(x: Array) -> Array:
    return (x + 4) / 6


def _rms_error(info: ProblemInfo, cost: Array) -> Array:
    """Root mean square error of an observation in pixels."""
    return jnp.sqrt(2 * cost / info.observations)
