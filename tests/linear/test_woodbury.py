"""The solve by way of the points' side against NumPy's solution of the formed reduced camera
system."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support

from jaxba import StepOptions, build_layout, initial_state, lm_step, random_scene, scene_like
from jaxba.linear import factored
from jaxba.linear.woodbury import capacitance_solve
from jaxba.structure.density import has_few_points

CAMERAS = 4
COLUMNS = 6


def system(seed: int = 0, smallest: float = 1e-3) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """W, B and b; `smallest` is the least eigenvalue of S relative to B's metric: negative makes S
    indefinite."""
    rng = np.random.default_rng(seed)
    root = 0.3 * rng.normal(size=(CAMERAS, 9, 9)) + 3 * np.eye(9)
    left, _ = np.linalg.qr(rng.normal(size=(9 * CAMERAS, COLUMNS)))
    turn, _ = np.linalg.qr(rng.normal(size=(COLUMNS, COLUMNS)))
    scaled = (
        left * np.sqrt(1 - np.geomspace(abs(smallest), 0.9, COLUMNS) * np.sign(smallest)) @ turn
    )
    wide = (root @ scaled.reshape(CAMERAS, 9, COLUMNS)).reshape(9 * CAMERAS, COLUMNS)
    return wide, root @ root.transpose(0, 2, 1), rng.normal(size=(CAMERAS, 9))


def formed(wide: np.ndarray, blocks: np.ndarray) -> np.ndarray:
    """S."""
    matrix = -wide @ wide.T
    for k, block in enumerate(blocks):
        matrix[9 * k : 9 * k + 9, 9 * k : 9 * k + 9] += block
    return matrix


solve = jax.jit(capacitance_solve)


def expected(wide, blocks, right) -> np.ndarray:
    """NumPy's solution."""
    return np.linalg.solve(formed(wide, blocks), right.reshape(-1)).reshape(right.shape)


def check(found, wide, blocks, right, tolerance: float) -> None:
    truth = expected(wide, blocks, right)
    assert np.linalg.norm(found - truth) <= tolerance * np.linalg.norm(truth)


@pytest.mark.parametrize("seed", range(4))
def test_the_formed_system_is_solved_as_numpy_solves_it(seed):
    wide, blocks, right = system(seed)
    check(solve(wide, blocks, right), wide, blocks, right, 1e-10)


def test_units_of_the_unknowns_do_not_matter():
    """Focal lengths in pixels beside rotations in radians: the scale spans 24 orders of
    magnitude."""
    wide, blocks, right = system()
    unit = (
        np.random.default_rng(2)
        .permutation(np.geomspace(1e-6, 1e6, 9 * CAMERAS))
        .reshape(CAMERAS, 9)
    )
    scaled = blocks * unit[:, :, None] * unit[:, None, :]
    found = solve(wide * unit.reshape(-1, 1), scaled, right * unit) * unit
    check(found, wide, blocks, right, 1e-10)


def test_columns_without_an_observation_change_nothing():
    """As a padding point has them."""
    wide, blocks, right = system()
    padded = np.concatenate([wide, np.zeros((len(wide), 3))], axis=1)
    check(solve(padded, blocks, right), wide, blocks, right, 1e-10)


def test_a_system_that_is_not_positive_definite_has_no_finite_solution_and_harms_no_neighbour():
    """Once by the coupling, once by a camera's own block."""
    good = system()
    by_coupling = system(1, smallest=-1e-6)
    by_block = system(2)
    by_block[1][-1] -= 12 * np.eye(9)
    assert np.linalg.eigvalsh(by_block[1][-1])[0] < 0
    batch = [np.stack(parts) for parts in zip(good, by_coupling, by_block, system(3), strict=True)]
    found = np.asarray(jax.jit(jax.vmap(solve))(*batch))
    assert not np.isfinite(found[1]).all()
    assert not np.isfinite(found[2]).all()
    check(found[0], *good, 1e-10)
    check(found[3], *system(3), 1e-10)


def test_batches_of_batches_are_solved_too():
    batch = [
        np.stack(parts).reshape(2, 3, *parts[0].shape)
        for parts in zip(*map(system, range(6)), strict=True)
    ]
    found = jax.jit(jax.vmap(jax.vmap(solve)))(*batch)
    for seed in range(6):
        check(found[divmod(seed, 3)], *system(seed), 1e-10)


@pytest.mark.parametrize("mode", [jax.jacfwd, jax.jacrev])
def test_derivatives_are_those_of_the_inverse(mode):
    """`d(S^-1 b) = -S^-1 dS S^-1 b`, here for a factor on B."""
    wide, blocks, right = system(smallest=0.1)
    found = mode(lambda factor: solve(wide, factor * blocks, right))(1.0)
    inner = expected(wide, blocks, right).reshape(-1)
    change = formed(np.zeros_like(wide), blocks) @ inner
    truth = -np.linalg.solve(formed(wide, blocks), change).reshape(right.shape)
    assert np.linalg.norm(found - truth) <= 1e-9 * np.linalg.norm(truth)


def test_float32_is_solved_to_single_precision():
    wide, blocks, right = system(smallest=0.1)
    found = solve(*(part.astype(np.float32) for part in (wide, blocks, right)))
    assert found.dtype == jnp.float32
    check(found, wide, blocks, right, 300 * float(np.finfo(np.float32).eps))


@pytest.mark.slow
@pytest.mark.parametrize("damping", [1e-6, 1e-3, 1.0])
def test_a_step_by_way_of_the_points_is_the_step_by_way_of_the_cameras(monkeypatch, damping):
    """With a camera that nobody observes."""
    problem = random_scene(scene_like("paper"), 0)
    seen = problem.camera_index != 3
    problem = problem.replace(
        observations=problem.observations[seen],
        camera_index=problem.camera_index[seen],
        point_index=problem.point_index[seen],
    )
    layout = jax.tree.map(jnp.asarray, build_layout(problem))
    assert layout.grid is not None
    assert has_few_points(*layout.grid.shape)
    before = initial_state(layout, problem, StepOptions())
    one = lm_step(layout, before, jnp.asarray(damping), StepOptions())[0]
    monkeypatch.setattr(factored, "has_few_points", lambda points, cameras: False)
    other = lm_step(layout, before, jnp.asarray(damping), StepOptions())[0]

    def moved(after):
        return jax.tree.leaves(jax.tree.map(lambda a, b: np.asarray(a - b), after, before))

    for found, truth in zip(moved(one), moved(other), strict=True):
        assert np.linalg.norm(found - truth) <= 1e-7 * np.linalg.norm(truth)
    assert not support.same_bits(one, before)
    assert np.asarray(one.cameras)[:, 3].tobytes() == np.asarray(before.cameras)[:, 3].tobytes()


def test_scenes_with_many_points_are_left_to_the_cameras_side():
    assert has_few_points(11, 10)
    assert not has_few_points(41, 10)
