"""Warm starts: scenes that begin after a few heavily damped iterations.

Real problems mostly begin where an incremental reconstruction ended: each camera and its points agree well with their
neighbours, and the remaining error lies along directions of small curvature. Errors drawn independently for cameras and
points are different. So a fraction of the scenes begins after a few heavily damped iterations, which remove the error
along directions of large curvature and leave the rest.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba.game.groups import step_groups
from jaxba.game.random_scenes import SceneClass, Scenes
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState
from jaxba.lm.step import lm_step, state_at
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit

ITERATIONS = 10
"""Largest number of iterations before a warm start; the number is uniform from one on."""

DAMPING = (1e-4, 1.0)
"""Lambda of these iterations, log-uniform per scene: from Ceres' first one to one at which damping dominates."""


@functools.partial(jit, static_argnames=("kind", "options"))
def warm_starts(
    kind: SceneClass,
    scenes: Scenes,
    initial: Float[Array, " scenes"],
    key: Array,
    fraction: Float[Array, ""] | float,
    options: StepOptions,
) -> tuple[Scenes, Float[Array, " scenes"]]:
    """Moves the start of a fraction of the scenes by a few heavily damped iterations.

    Args:
        kind: class of the scenes.
        scenes: with starts as drawn.
        initial: costs of these starts, pixels squared.
        key: random key.
        fraction: of the scenes that are moved, chosen at random.
        options: of the steps.

    Returns:
        The scenes and the costs of their starts, never larger than before.
    """
    layout = class_layout(kind, options)
    a, b, c = jax.random.split(key, 3)
    rows = (len(initial),)
    count = jax.random.randint(a, rows, 1, ITERATIONS + 1) * jax.random.bernoulli(b, fraction, rows)
    low, high = (jnp.log(jnp.asarray(x, initial.dtype)) for x in DAMPING)
    damping = jnp.exp(jax.random.uniform(c, rows, initial.dtype, low, high))

    def one(scene: Scenes, cost: Array, count: Array, damping: Array) -> LMState:
        seen = with_scene(layout, scene.pixels, scene.mask)

        def body(iteration: Array, state: LMState) -> LMState:
            after, _ = lm_step(seen, state, damping, options, 0.0, iteration)
            return jax.tree.map(lambda new, old: jnp.where(iteration < count, new, old), after, state)

        return lax.fori_loop(0, ITERATIONS, body, state_at(scene.cameras, scene.points, cost, options))

    moved = step_groups(one, scenes, initial, count, damping)
    return scenes._replace(cameras=moved.cameras, points=moved.points), moved.cost
