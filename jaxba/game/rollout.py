"""Plays a damping policy on every scene of a bank, many at a time, each to its end.

A compiled loop over lanes: when a scene ends, its lane starts the next one, so that no lane waits for the slowest
scene.
"""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping import DampingPolicy
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Tolerances, converged_in_cost
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.solver.iteration import Carry, begin, iterate
from jaxba.solver.lanes import refill

LANES = 128  # scenes solved at a time


class Trajectories(NamedTuple):
    """Costs and lambdas of a policy on every scene; NumPy arrays."""

    costs: Float[np.ndarray, "scenes iterations"]
    """Accepted cost after each iteration, the start first; constant after the end."""

    dampings: Float[np.ndarray, "scenes iterations"]
    """Lambda of each iteration; zero after the end."""

    iterations: Int[np.ndarray, " scenes"]
    """Linear solves until the end."""

    converged: Bool[np.ndarray, " scenes"]
    """Whether the convergence test ended it, and not the limit."""


@for_traces
def play(
    kind: SceneClass, bank: Any, policy: DampingPolicy, options: StepOptions, limit: int, ftol: float = 1e-6
) -> Trajectories:
    """Solves every scene of the bank.

    Args:
        kind: the bank's class.
        bank: scenes with their `ProblemInfo`.
        policy: chooses lambda; a pytree, so that policies of one class share a program.
        options: of the steps.
        limit: largest number of linear solves per scene.
        ftol: relative decrease of an accepted step below which a scene has converged (`converged_in_cost`).
    """
    check_x64(bank.initial_cost.dtype)
    played = _play(kind, bank, policy, options, limit, jnp.asarray(ftol, bank.initial_cost.dtype))
    found: Trajectories = jax.tree.map(np.asarray, played)
    costs = np.concatenate([np.asarray(bank.initial_cost)[:, None], found.costs], axis=1)
    past = np.arange(limit + 1) > found.iterations[:, None]
    last = np.take_along_axis(costs, found.iterations[:, None], axis=1)
    return found._replace(costs=np.where(past, last, costs))


@functools.partial(jit, static_argnames=("kind", "options", "limit"))
def _play(
    kind: SceneClass, bank: Any, policy: DampingPolicy, options: StepOptions, limit: int, ftol: Array
) -> Trajectories:
    """`Trajectories` of JAX arrays; costs without the start."""
    layout = class_layout(kind, options)
    count = bank.initial_cost.shape[0]

    def fresh(scene: Int[Array, ""]) -> Carry:
        at = lambda tree: jax.tree.map(lambda x: x[scene], tree)
        start = at(bank.scenes)
        state = LMState(start.cameras, start.points, at(bank.initial_cost))
        return begin(at(bank.info), policy, state)

    def advance(scene: Int[Array, ""], carry: Carry) -> tuple[Carry, tuple[StepInfo, Array], Bool[Array, ""]]:
        seen = with_scene(layout, bank.scenes.pixels[scene], bank.scenes.mask[scene])
        carry, step = iterate(seen, carry, policy, Tolerances(), options, limit)
        converged = converged_in_cost(step, ftol)
        return carry, (step, converged), converged | (carry.iteration >= limit)

    def note(found: Any, scene: Array, carry: Carry, record: Any, _: Array) -> Any:
        (step, converged), iteration = record, carry.iteration
        return found._replace(
            costs=found.costs.at[scene, iteration - 1].set(step.cost, mode="drop"),
            dampings=found.dampings.at[scene, iteration - 1].set(step.damping, mode="drop"),
            iterations=found.iterations.at[scene].set(iteration, mode="drop"),
            converged=found.converged.at[scene].set(converged, mode="drop"),
        )

    rows = np.zeros((count, limit), bank.initial_cost.dtype)
    nothing = Trajectories(rows, rows, np.zeros(count, np.int32), np.zeros(count, bool))
    return refill(count, count, min(LANES, count), fresh, advance, note, jax.tree.map(jnp.asarray, nothing))
