"""What a step needs of the device's memory, by XLA's own account of the program it has made."""

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxba import (
    Refinement,
    StepOptions,
    build_layout,
    initial_state,
    lm_step,
    random_scene,
    scene_like,
)
from jaxba.lm.termination import Tolerances
from jaxba.solver import sharded
from jaxba.solver.estimate import BYTES_IN_PARTS, BYTES_PER_OBSERVATION
from jaxba.solver.options import SolveOptions
from jaxba.solver.prepare import set_up

pytestmark = pytest.mark.xla


def bytes_per_observation(problem, options, dtype):
    layout = build_layout(problem, options)
    state = jax.eval_shape(lambda layout: initial_state(layout, problem, options, dtype), layout)
    damping = jax.ShapeDtypeStruct((), dtype)
    step = jax.jit(lambda layout, state, damping: lm_step(layout, state, damping, options))
    memory = step.lower(layout, state, damping).compile().memory_analysis()
    assert memory is not None
    total = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    return total / problem.num_observations


@pytest.mark.slow
@pytest.mark.parametrize(("dtype", "refine"), [(jnp.float64, 3), (jnp.float32, 0)])
def test_an_implicit_step_keeps_to_the_stated_bytes_per_observation(dtype, refine):
    problem = random_scene(scene_like("random-150"), 0)
    used = bytes_per_observation(
        problem, StepOptions(linear_solver="implicit", refinement=Refinement(points=refine)), dtype
    )
    # below half of the stated figure it would be the figure that is wrong
    stated = BYTES_PER_OBSERVATION[jnp.dtype(dtype).name]
    assert 0.5 * stated < used < stated


@pytest.mark.slow
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_step_in_parts_and_the_problem_keep_to_the_stated_bytes_per_observation(
    dtype, monkeypatch
):
    problem = random_scene(replace(scene_like("random-150"), cameras=50), 0)
    for name, value in (
        ("LARGE", 1),
        ("PART", problem.num_observations // 16),
        ("PART_OF_CAMERA", 0),
    ):
        monkeypatch.setattr(sharded, name, value)
    setup = set_up(
        problem, "guarded", SolveOptions(linear_solver="implicit", dtype=dtype), in_parts=True
    )
    limit = np.asarray(5, np.int32)
    carry = setup.shards.begin(setup.policy, limit)
    given = setup.shards.layout, carry, setup.policy, Tolerances(), limit
    memory = sharded._run.lower(*given, **setup.shards.static, length=0).compile().memory_analysis()
    assert memory is not None
    parts = memory.argument_size_in_bytes + memory.output_size_in_bytes + memory.temp_size_in_bytes
    arrays = (
        problem.cameras,
        problem.points,
        problem.observations,
        problem.camera_index,
        problem.point_index,
    )
    used = (parts + sum(array.nbytes for array in arrays)) / problem.num_observations
    assert 0.5 * BYTES_IN_PARTS[dtype] < used < BYTES_IN_PARTS[dtype]


@pytest.mark.slow
def test_memory_of_an_implicit_step_grows_with_the_observations_only():
    options = StepOptions(linear_solver="implicit")
    sizes = [
        replace(scene_like("random-150"), points=points, observations=4 * points, cameras=50)
        for points in (5_000, 20_000)
    ]
    small, large = (
        bytes_per_observation(random_scene(size, 0), options, jnp.float64) for size in sizes
    )
    assert large < 1.1 * small
