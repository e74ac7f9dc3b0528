"""The program around: a solve sets what it needs, and leaves the process as it was."""

from __future__ import annotations

import multiprocessing
import signal
import sys
import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from support import DAMPINGS, paper, solve_options
from threadpoolctl import threadpool_info, threadpool_limits

import jaxba
from jaxba.runtime import process
from jaxba.runtime.numerics import numerics

PYPROJECT = Path(jaxba.__file__).parents[1] / "pyproject.toml"

SURROUNDINGS = {
    "strict promotion of types": lambda: jax.numpy_dtype_promotion("strict"),
    "no promotion of ranks": lambda: jax.numpy_rank_promotion("raise"),
    "no implicit transfers": lambda: jax.transfer_guard("disallow"),
    "NaN is an error": lambda: jax.debug_nans(True),
    "other random numbers": lambda: jax.default_prng_impl("rbg"),
    "products of bfloat16": lambda: jax.default_matmul_precision("bfloat16"),
    "32 bits": lambda: jax.enable_x64(False),
    "rounding of NumPy is an error": lambda: np.errstate(all="raise"),
    "nothing is compiled": lambda: jax.disable_jit(),
}
"""Settings of the program around a solve."""

GAUGED = jaxba.with_gauge(paper(0), "two-cameras")
OPTIONS = solve_options(max_iterations=4)


def numbers() -> list[np.ndarray]:
    """What the public functions of a problem find."""
    solution = jaxba.solve(GAUGED, "ceres", OPTIONS)
    searched = jaxba.retriangulate(GAUGED)
    return [
        solution.problem.cameras,
        jaxba.covariance(GAUGED).poses,
        np.asarray(searched.cost_after),
    ]


@pytest.fixture(scope="module")
def expected() -> list[np.ndarray]:
    return numbers()


@pytest.mark.parametrize("name", SURROUNDINGS)
def test_the_settings_of_the_program_around_change_no_result(name, expected):
    with SURROUNDINGS[name]():
        found = numbers()
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-12 * np.abs(other).max())


@pytest.mark.parametrize("name", ["strict promotion of types", "no promotion of ranks"])
def test_a_step_can_be_traced_under_the_settings_of_the_program_around(name):
    prepared = jaxba.prepare(GAUGED, "ceres", OPTIONS)

    def cost(damping):
        return jaxba.lm_step(prepared.layout, prepared.state, damping, prepared.options)[0].cost

    with SURROUNDINGS[name]():
        shape = jax.eval_shape(cost, DAMPINGS[0])
    assert shape.dtype == np.float64


@pytest.mark.parametrize("transform", [jax.jit, jax.grad, lambda f: lambda x: jax.vmap(f)(x[None])])
@pytest.mark.parametrize(
    "call",
    [
        lambda q: jaxba.solve(q).final_cost,
        lambda q: jaxba.solve_and_retriangulate(q).final_cost,
        lambda q: jaxba.covariance(q).poses,
        lambda q: jaxba.prepare(q).state.cost,
        lambda q: jaxba.retriangulate(q).cost_after,
        lambda q: jaxba.differentiable_solve(q)(jaxba.inputs_of(q))[0].sum(),
        lambda q: (
            jaxba.BundleProblem.create(
                q.cameras, q.points, q.observations, q.camera_index, q.point_index
            ).num_points
        ),
    ],
)
def test_a_call_that_jax_traces_names_what_to_use_instead(call, transform):
    with pytest.raises(
        TypeError, match=r"JAX traces this call .*solve_loop .*prepare .*differentiable_solve"
    ) as caught:
        transform(lambda pixels: call(GAUGED.replace(observations=pixels)))(
            jnp.asarray(GAUGED.observations)
        )
    assert "\n" not in str(caught.value)


def test_a_problem_of_numpy_inside_of_jit_is_refused_as_well():
    with pytest.raises(TypeError, match="JAX traces this call"):
        jax.jit(lambda x: x + jaxba.solve(GAUGED).final_cost)(1.0)


def test_float64_without_64_bits_is_refused_by_all_that_would_compute_in_float32():
    prepared = jaxba.prepare(GAUGED, "ceres", OPTIONS)
    layout = prepared.layout
    state = prepared.state
    options = prepared.options
    find = jaxba.differentiable_solve(GAUGED)
    inputs = jaxba.inputs_of(GAUGED)
    calls = [
        lambda: jaxba.solve_loop(layout, state, prepared.policy, jaxba.Tolerances(), options, 3),
        lambda: jaxba.lm_step(layout, state, jnp.asarray(1e-4), options),
        lambda: jaxba.initial_state(layout, GAUGED, options),
        lambda: find(inputs),
    ]
    with jax.enable_x64(False):
        for call in calls:
            with pytest.raises(ValueError, match="jax_enable_x64"):
                call()


def refusals(connection) -> None:
    """What public functions raise in a worker."""
    process_of = {
        "solve": lambda: jaxba.solve(GAUGED),
        "covariance": lambda: jaxba.covariance(GAUGED),
        "prepare": lambda: jaxba.prepare(GAUGED),
        "retriangulate": lambda: jaxba.retriangulate(GAUGED),
        "differentiable_solve": lambda: jaxba.differentiable_solve(GAUGED),
        "solve_loop": lambda: jaxba.solve_loop(*[None] * 6),  # pyright: ignore[reportArgumentType]
        "lm_step": lambda: jaxba.lm_step(*[None] * 4),  # pyright: ignore[reportArgumentType]
    }
    told = {}
    for name, call in process_of.items():
        try:
            call()
        except RuntimeError as error:
            told[name] = str(error)
    connection.send((list(process_of), told))


@pytest.mark.skipif(not hasattr(signal, "SIGALRM") or sys.platform == "darwin", reason="needs fork")
def test_a_forked_process_is_told_at_once_to_begin_anew():
    jax.block_until_ready(jnp.ones(1) + 1)
    here, there = multiprocessing.Pipe()
    worker = multiprocessing.get_context("fork").Process(target=refusals, args=(there,))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # JAX warns of forks
        worker.start()
    try:
        assert here.poll(60)
        called, told = here.recv()
    finally:
        worker.kill()
    assert list(told) == called
    assert all('get_context("spawn")' in text and "\n" not in text for text in told.values())


def blas_threads() -> list[int]:
    return [
        library["num_threads"] for library in threadpool_info() if library["user_api"] == "blas"
    ]


def test_contexts_that_overlap_give_blas_its_threads_back():
    with process.single_blas_thread():
        pass  # loads the library
    with threadpool_limits(2, "blas"):
        check_overlap()


def check_overlap() -> None:
    before = blas_threads()
    assert set(before) == {2}
    entered = threading.Event()
    leave = threading.Event()

    def other() -> None:
        with process.single_blas_thread():
            entered.set()
            leave.wait(60)

    with ThreadPoolExecutor(1) as pool:
        with numerics(np.float64):
            running = pool.submit(other)
            assert entered.wait(60)
        assert set(blas_threads()) == {1}  # the other needs it still
        leave.set()
        running.result(60)
    assert blas_threads() == before
