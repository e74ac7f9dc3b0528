"""A look-ahead oracle: beam search over lambda, an estimate of the fewest iterations that any choice of lambda needs.

It tries every lambda of a grid from every state of the beam and keeps the states of lowest cost, which takes
`width x grid` times the work of a solve. With a beam of one it is the greedy choice, which needs more iterations: the
lowest next cost does not lead to the lowest final cost.
"""

from __future__ import annotations

import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxba.game.random_scenes import SceneClass
from jaxba.game.rollout import Trajectories, step_groups
from jaxba.game.scene_bank import Bank
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import lm_step, state_at
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit

GRID = tuple(10.0**decade for decade in (-8, -7, -6, -5, -4, -3, -2, -1, 0))
"""Lambdas tried from every state."""

WIDTH = 4
"""States kept."""


def beam_search(
    step: Callable[[LMState, Array], tuple[LMState, StepInfo]],
    start: LMState,
    iterations: int,
    width: int = WIDTH,
    grid: tuple[float, ...] = GRID,
) -> Float[Array, " _"]:
    """Lowest accepted cost after each number of iterations, the start first.

    Args:
        step: one LM iteration from a state with a lambda; pure.
        start: first state.
        iterations: linear solves in a row.
        width: states kept after each iteration. States of equal cost come last, since they are mostly the same state.
        grid: lambdas.
    """
    pairs = [(state, damping) for state in range(width) for damping in range(len(grid))]
    parent = jnp.array([pair[0] for pair in pairs])
    dampings = jnp.asarray(grid, start.cost.dtype)[jnp.array([pair[1] for pair in pairs])]
    beam = jax.tree.map(lambda x: jnp.broadcast_to(x, (width, *x.shape)), start)
    beam = beam._replace(cost=beam.cost.at[1:].set(jnp.inf))

    def body(beam: LMState, _: None) -> tuple[LMState, Array]:
        origin = jax.tree.map(lambda x: x[parent], beam)
        after, info = step_groups(step, origin, dampings)
        alive = info.accepted & jnp.isfinite(origin.cost)
        costs = jnp.concatenate([jnp.where(alive, after.cost, jnp.inf), beam.cost])
        order = jnp.argsort(costs)
        duplicate = jnp.concatenate([jnp.zeros(1, bool), jnp.diff(costs[order]) <= 0])
        best = order[jnp.argsort(jnp.where(duplicate, jnp.inf, costs[order]))[:width]]
        kept = jax.tree.map(lambda new, old: jnp.concatenate([new, old])[best], after, beam)
        beam = kept._replace(cost=costs[best])
        return beam, beam.cost[0]

    costs = lax.scan(body, beam, None, length=iterations)[1]
    return jnp.concatenate([start.cost[None], costs])


@functools.partial(jit, static_argnames=("kind", "options", "iterations", "width", "grid"))
def _search(
    kind: SceneClass, bank: Bank, options: StepOptions, iterations: int, width: int, grid: tuple[float, ...]
) -> Array:
    layout = class_layout(kind, options)

    def one(scene: Bank) -> Array:
        seen = with_scene(layout, scene.scenes.pixels, scene.scenes.mask)
        start = state_at(scene.scenes.cameras, scene.scenes.points, scene.initial_cost, options)
        step = lambda state, damping: lm_step(seen, state, damping, options)
        return beam_search(step, start, iterations, width, grid)

    return lax.map(one, bank)


def oracle(
    kind: SceneClass,
    bank: Bank,
    options: StepOptions,
    iterations: int,
    width: int = WIDTH,
    grid: tuple[float, ...] = GRID,
) -> Trajectories:
    """The search on every scene of a bank; the lambdas of the best sequence are not returned."""
    costs = np.asarray(_search(kind, bank, options, iterations, width, grid))
    count = len(costs)
    return Trajectories(costs, np.zeros_like(costs[:, 1:]), np.full(count, iterations), np.zeros(count, bool))
