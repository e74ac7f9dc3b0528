"""Observations that stand for rows of residuals are summed with those of pixels, in every kind of
layout."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest
import row_examples
from row_examples import MAKERS, OWN, READY_MADE

from jaxba import StepOptions, build_layout
from jaxba.solver.place import placed
from jaxba.solver.sharded import deal_points, sharded_layout, shards_of
from jaxba.structure.padding import Capacity
from jaxba.structure.segment_sums import point_sum, tree_sum

CELL = Capacity(cameras=8, points=64, observations=512, pairs=2048, fixed=True)
"""Holds a scene with rows of any residual."""


def layouts(problem, kind: str) -> list:
    """Each layout of a problem, with the observations and the points that are its own."""
    if kind != "parts":
        capacity = CELL if kind == "padded" else None
        layout = build_layout(problem, StepOptions(), capacity, grid=False)
        return [(layout, np.arange(problem.num_observations), np.arange(problem.num_points))]
    together = [rows.points for rows in problem.residuals.rows]
    dealt = [points for points in deal_points(problem, 3, together) if len(points)]
    made = sharded_layout(shards_of(problem, dealt), StepOptions(linear_solver="implicit"))
    of = [np.flatnonzero(np.isin(problem.point_index, points)) for points in dealt]
    return list(zip(made, of, dealt, strict=True))


def test_every_ready_made_residual_has_an_example():
    assert set(MAKERS) == {*READY_MADE, OWN}


@pytest.mark.parametrize(
    "kind", [*(pytest.param(x, marks=pytest.mark.slow) for x in ("buckets", "parts")), "padded"]
)
def test_sums_over_points_and_cameras_have_the_observations_of_rows(kind):
    for name in (*READY_MADE, OWN):
        problem = placed(row_examples.with_rows_of(row_examples.scene(0), [name], 0)).here
        rng = np.random.default_rng(1)
        values = rng.integers(1, 1 << 20, problem.num_observations).astype(float)
        by_point = np.zeros(problem.num_points)
        by_camera = np.zeros(problem.num_cameras)
        for layout, observations, points in layouts(problem, kind):
            in_slots = jnp.asarray(np.append(values[observations], 0.0)[layout.observation])
            sums = np.append(point_sum(layout, in_slots[None])[0], 0.0)
            real = layout.points < len(points)
            by_point[points[layout.points[real]]] += sums[:-1][real]
            by_camera += np.asarray(tree_sum(in_slots, layout.camera_levels))[: problem.num_cameras]
        np.testing.assert_array_equal(
            by_point, np.bincount(problem.point_index, values), err_msg=name
        )
        np.testing.assert_array_equal(
            by_camera, np.bincount(problem.camera_index, values), err_msg=name
        )


@pytest.mark.parametrize("kind", ["buckets", "padded"])
def test_the_slots_of_a_row_hold_its_observations(kind):
    for name in (*READY_MADE, OWN):
        problem = placed(row_examples.with_rows_of(row_examples.scene(0), [name], 0)).here
        ((layout, *_),) = layouts(problem, kind)
        (given,) = problem.residuals.rows
        (rows,) = layout.residuals
        np.testing.assert_array_equal(
            np.moveaxis(layout.observation[rows.slots], 2, 0), given.observation
        )
        pixels = np.asarray(layout.slot_mask)
        used = np.asarray(layout.slot_used)
        assert not pixels[rows.slots].any(), name
        assert used[rows.slots].all(), name
        assert used.sum() == problem.num_observations, name
        assert pixels.sum() == problem.num_observations - given.observation.size, name
