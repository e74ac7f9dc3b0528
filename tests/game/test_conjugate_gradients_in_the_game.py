"""Conjugate gradients inside the game: the steps of the paper's agent are those of dense
algebra."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.game.random_scenes import SceneClass, Scenes, make_scenes
from jaxba.game.scene_bank import initial_costs
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState
from jaxba.lm.step import propose
from jaxba.training.config import load

SCENES = 64


def test_a_vmapped_step_of_the_papers_scenes_is_that_of_dense_algebra():
    config = load("paper")
    kind = config.bank.kind
    assert kind == SceneClass(10, 10, "paper")
    scenes = make_scenes(kind, jax.random.key(3), SCENES)
    costs = initial_costs(kind, scenes)

    def steps(options, damping):
        def one(scene: Scenes, cost):
            layout = with_scene(class_layout(kind, options), scene.pixels, scene.mask)
            state = LMState(scene.cameras, scene.points, cost)
            return propose(layout, state, damping, options).step

        return jax.vmap(one)(scenes, costs)

    run = jax.jit(steps, static_argnums=0)
    iterative = config.step_options
    assert iterative.linear_solver == "cg"
    dense = replace(iterative, linear_solver="explicit")
    for decades, distance in ((-10.0, 1e-4), (-2.0, 1e-7)):
        (found, truth) = (
            run(options, jnp.asarray(10.0**decades)) for options in (iterative, dense)
        )
        # d.(H + D) d of the solution less that of an iterate is the squared energy norm of what it
        # lacks
        lacking = np.sqrt(np.abs(np.asarray(1 - found.slope / truth.slope)))
        assert lacking.shape == (SCENES,)
        assert np.max(lacking) < distance
