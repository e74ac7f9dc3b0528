"""Warm starts: scenes that somebody has already worked on.

Real problems mostly begin where an incremental reconstruction ended: each camera and its points agree well with their
neighbours, and what is left lies along the directions in which the whole bends easily. Errors drawn independently for
cameras and points are nothing like it. So a share of the scenes begins where a few heavily damped iterations end: these
remove what is stiff and leave what is weak.
"""

from __future__ import annotations

import functools

import jax
import jax.numpy as jnp
from jax import Array, lax
from jaxtyping import Float

from jaxba.game.random_scenes import SceneClass, Scenes
from jaxba.game.rollout import step_groups
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState
from jaxba.lm.step import lm_step, state_at
from jaxba.problem.options import StepOptions

ITERATIONS = 10
"""Most iterations that a warm start has behind it; their number is uniform from one on."""

DAMPING = (1e-4, 1.0)
"""Lambda of these iterations, log-uniform per scene: from Ceres' first one to one that holds most of a scene."""


@functools.partial(jax.jit, static_argnames=("kind", "options"))
def warm_starts(
    kind: SceneClass,
    scenes: Scenes,
    initial: Float[Array, " scenes"],
    key: Array,
    share: Float[Array, ""] | float,
    options: StepOptions,
) -> tuple[Scenes, Float[Array, " scenes"]]:
    """Moves the start of a share of the scenes to where a few heavily damped iterations lead.

    Args:
        kind: class of the scenes.
        scenes: with starts as drawn.
        initial: their costs, pixels squared.
        key: random key.
        share: of the scenes that are moved, each chosen at random.
        options: of the steps.

    Returns:
        The scenes and the costs of their starts, never larger than before.
    """
    layout = class_layout(kind, options)
    a, b, c = jax.random.split(key, 3)
    rows = (len(initial),)
    count = jax.random.randint(a, rows, 1, ITERATIONS + 1) * jax.random.bernoulli(b, share, rows)
    low, high = (jnp.log(jnp.asarray(x, initial.dtype)) for x in DAMPING)
    damping = jnp.exp(jax.random.uniform(c, rows, initial.dtype, low, high))

    def one(scene: Scenes, cost: Array, count: Array, damping: Array) -> LMState:
        own = with_scene(layout, scene.pixels, scene.mask)

        def body(turn: Array, state: LMState) -> LMState:
            after, _ = lm_step(own, state, damping, options, 0.0, turn)
            return jax.tree.map(lambda new, old: jnp.where(turn < count, new, old), after, state)

        return lax.fori_loop(0, ITERATIONS, body, state_at(scene.cameras, scene.points, cost, options))

    moved = step_groups(one, scenes, initial, count, damping)
    return scenes._replace(cameras=moved.cameras, points=moved.points), moved.cost
