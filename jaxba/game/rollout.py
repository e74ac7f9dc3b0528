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
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.damping import DampingPolicy
from jaxba.game.groups import step_groups
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Tolerances, converged_in_cost
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.solver.iteration import Carry, begin, iterate

LANES = 128
"""Scenes solved at a time."""


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
    found: Trajectories = jax.tree.map(lambda x: np.asarray(x)[:-1], played)
    costs = np.concatenate([np.asarray(bank.initial_cost)[:, None], found.costs], axis=1)
    past = np.arange(limit + 1) > found.iterations[:, None]
    last = np.take_along_axis(costs, found.iterations[:, None], axis=1)
    return found._replace(costs=np.where(past, last, costs))


@functools.partial(jit, static_argnames=("kind", "options", "limit"))
def _play(
    kind: SceneClass, bank: Any, policy: DampingPolicy, options: StepOptions, limit: int, ftol: Array
) -> Trajectories:
    """`Trajectories` of JAX arrays, with an extra row for idle lanes; costs without the start."""
    layout = class_layout(kind, options)
    count = bank.initial_cost.shape[0]
    lanes = min(LANES, count)

    def fresh(scene: Int[Array, ""]) -> tuple[Array, Carry]:
        at = lambda tree: jax.tree.map(lambda x: x[jnp.minimum(scene, count - 1)], tree)  # idle lanes repeat the last
        start = at(bank.scenes)
        state = LMState(start.cameras, start.points, at(bank.initial_cost))
        return scene, begin(at(bank.info), policy, state)

    def advance(scene: Array, carry: Carry) -> tuple[Carry, StepInfo]:
        row = jnp.minimum(scene, count - 1)
        seen = with_scene(layout, bank.scenes.pixels[row], bank.scenes.mask[row])
        return iterate(seen, carry, policy, Tolerances(), options, limit)

    def body(loop: tuple[Any, ...]) -> tuple[Any, ...]:
        (scene, carry), next_scene, found = loop
        carry, step = step_groups(advance, scene, carry)
        row = jnp.minimum(scene, count)  # idle lanes write to an extra row that is dropped
        converged = jax.vmap(converged_in_cost, in_axes=(0, None))(step, ftol)
        iteration = carry.iteration
        done = converged | (iteration >= limit)
        found = found._replace(
            costs=found.costs.at[row, iteration - 1].set(step.cost),
            dampings=found.dampings.at[row, iteration - 1].set(step.damping),
            iterations=found.iterations.at[row].set(iteration),
            converged=found.converged.at[row].set(converged),
        )
        new = jax.vmap(fresh)((next_scene + jnp.cumsum(done) - 1).astype(jnp.int32))
        pick = lambda new, old: jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)
        return jax.tree.map(pick, new, (scene, carry)), (next_scene + jnp.sum(done)).astype(jnp.int32), found

    rows = np.zeros((count + 1, limit), bank.initial_cost.dtype)
    nothing = Trajectories(rows, rows, np.zeros(count + 1, np.int32), np.zeros(count + 1, bool))
    first = jax.vmap(fresh)(jnp.arange(lanes, dtype=jnp.int32))
    loop = first, jnp.asarray(lanes, jnp.int32), jax.tree.map(jnp.asarray, nothing)
    return lax.while_loop(lambda loop: jnp.any(loop[0][0] < count), body, loop)[2]
