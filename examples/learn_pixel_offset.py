"""Learns a systematic offset of pixels from measured camera positions, by derivatives of a solve.

    python examples/learn_pixel_offset.py

A detector that puts every key-point some pixels too far to the right leaves hardly a trace in the
reprojection errors: a solve turns and moves the cameras instead. Their measured positions know
better. Here the offset is what makes the solved positions fit the measured ones, found by Adam with
gradients through the solve."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import optax

import jaxba

OFFSET = 3.0
"""The true offset, pixels."""

RATE = 0.3
STEPS = 60
"""Of Adam."""


def main() -> float:
    """Prints the offset of every step, and returns the last."""
    jax.config.update("jax_enable_x64", True)
    config = jaxba.SceneConfig(
        cameras=12, points=150, mean_track=6.0, trajectory="orbit", max_depth=10.0
    )
    scene, truth = jaxba.random_scene_with_truth(config, seed=0)
    observations = np.add(scene.observations, [OFFSET, 0.0])
    problem = scene.replace(cameras=truth.cameras, points=truth.points, observations=observations)
    problem = jaxba.hold(problem, lenses="all", poses=[0, 6])
    tight = jaxba.SolveOptions(tolerances=jaxba.Tolerances(ftol=1e-14), max_iterations=100)
    find = jaxba.differentiable_solve(problem, "ceres", tight)
    inputs = jax.tree.map(jnp.asarray, jaxba.inputs_of(problem))
    measured = jnp.asarray(truth.cameras[:, 3:6])

    def misfit(offset: jax.Array) -> jax.Array:
        shift = jnp.stack([offset, jnp.zeros_like(offset)])
        cameras, _ = find(inputs._replace(observations=inputs.observations - shift))
        return jnp.sum((cameras[:, 3:6] - measured) ** 2)

    adam = optax.adam(RATE)
    offset = jnp.zeros(())
    state = adam.init(offset)
    for step in range(STEPS):
        value, slope = jax.value_and_grad(misfit)(offset)
        print(f"step {step}: offset {float(offset):.3f}, misfit {float(value):.3e}")
        update, state = adam.update(slope, state)
        offset = jnp.asarray(optax.apply_updates(offset, update))
    return float(offset)


if __name__ == "__main__":
    main()
