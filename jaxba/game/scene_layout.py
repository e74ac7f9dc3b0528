"""The layout that all scenes of a class share, and how a scene's observations are put into it."""

from __future__ import annotations

import functools
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float

from jaxba.game.random_scenes import SceneClass
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.structure.layout import Layout, build_layout
from jaxba.typing import AnyArray


def class_layout(kind: SceneClass, options: StepOptions) -> Layout:
    """A layout with an observation slot for every pair of a camera and a point; see `with_scene`.

    Random clusters, if any, are those of a scene where all see all: scenes of a class share
    them."""
    return _layout(
        kind, StepOptions(method=options.method) if options.cluster_cameras else StepOptions()
    )


@functools.cache
def _layout(kind: SceneClass, options: StepOptions) -> Layout:
    count = kind.cameras * kind.points
    camera = np.tile(np.arange(kind.cameras), kind.points)
    point = np.repeat(np.arange(kind.points), kind.cameras)
    cameras = np.zeros((kind.cameras, 9))
    problem = BundleProblem.create(
        cameras, np.zeros((kind.points, 3)), np.zeros((count, 2)), camera, point
    )
    layout = build_layout(problem, options)
    if layout.grid is None and options.factors_reduced_system:
        raise AssertionError("scenes of the game are dense")
    return layout


def with_scene(
    layout: Layout, pixels: Float[AnyArray, "2 slots"], mask: Bool[AnyArray, " slots"]
) -> Layout:
    """The layout of the class with one scene's observations."""
    cameras = layout.num_cameras
    seen = jnp.any(mask.reshape(cameras, -1), axis=1)
    return replace(layout, pixels=pixels, slot_mask=mask, slot_used=mask, camera_seen=seen)
