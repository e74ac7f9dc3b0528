"""No program of this package is compiled with the fusions that make XLA's programs wrong."""

from __future__ import annotations

import ast
import re
from pathlib import Path

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
import pytest
import support
import toys
from jax._src import compiler
from tiny_game import tiny_game

import jaxba
from jaxba import (
    Loss,
    SolveOptions,
    covariance,
    differentiable_solve,
    hold,
    inputs_of,
    solve,
    solve_and_retriangulate,
)
from jaxba.game.gym import GymVectorGame
from jaxba.runtime.jit import RIGHT, jit, known_options, right_options
from jaxba.training.sac import SacConfig
from jaxba.training.train_loop import LoopConfig, run_chunk, start

on_a_cpu = pytest.mark.skipif(jax.default_backend() != "cpu", reason="YNNPACK is of CPUs")

WRONG = ("0.10.2",)
"""Versions of jaxlib that compute `squares` wrongly. Where none of those that jaxba runs on is
among them, and none crashes (jax-ml/jax#39257), `jaxba.runtime.jit` can go."""

OWN_OPTIONS = {"runtime/jit.py", "runtime/compilation.py"}
"""Files that may say `jax.jit`: they give the options themselves."""


def squares(x):
    return jax.vmap(lambda row: jnp.sum((jnp.eye(3, dtype=x.dtype) @ row) ** 2))(x)


@pytest.fixture(params=[("float64", 16_385), ("float32", 32_769)], ids=str)
def rows(request):
    """So many that XLA hands them to YNNPACK in several parts."""
    dtype, count = request.param
    return np.arange(3 * count, dtype=dtype).reshape(-1, 3) / count


def is_right(result, rows):
    return np.allclose(result, np.sum(rows.astype(float) ** 2, axis=1), rtol=1e-5)


@on_a_cpu
def test_what_xla_compiles_wrongly_is_right_in_a_program_of_ours(rows):
    # the control: where this fails, a version is right or wrong that was not, and `WRONG` is to be
    # changed
    assert is_right(jax.jit(squares)(rows), rows) == (jaxlib.__version__ not in WRONG)
    assert is_right(jit(squares)(rows), rows)
    inner = jit(lambda x: 2 * squares(x))
    assert is_right(jit(lambda x: inner(x) / 2)(rows), rows)


def test_it_is_called_inside_other_programs_and_transformations():
    cube = jit(lambda x, power=3: x**power, static_argnames="power")
    x = jnp.asarray([1.0, 2.0])
    wanted = np.array([1.0, 8.0])
    for call in (cube, jax.jit(cube), jax.vmap(cube), jit(cube), lambda x: jax.lax.map(cube, x)):
        np.testing.assert_array_equal(call(x), wanted)
    np.testing.assert_array_equal(jax.jacfwd(cube)(x), np.diag(3 * np.square(x)))
    np.testing.assert_array_equal(
        jax.grad(lambda x: jnp.sum(cube(x, power=3)))(x), 3 * np.square(x)
    )
    np.testing.assert_array_equal(cube.lower(x, power=2).compile()(x), np.square(x))


def test_no_module_compiles_without_the_options():
    folder = Path(jaxba.__file__).parent
    found = set()
    for file, text in ((file, file.read_text()) for file in folder.rglob("*.py")):
        for node in ast.walk(ast.parse(text)) if "jit" in text or "pmap" in text else ():
            of_jax = isinstance(node, ast.Attribute) and getattr(node.value, "id", "") == "jax"
            name = node.attr if of_jax else ""
            if isinstance(node, ast.ImportFrom) and node.module == "jax":
                name = next(
                    (alias.name for alias in node.names if alias.name in ("jit", "pmap")), ""
                )
            if name in ("jit", "pmap"):
                found.add(file.relative_to(folder).as_posix())
    assert found == OWN_OPTIONS


def test_an_option_that_a_jaxlib_does_not_know_is_left_out():
    assert known_options({"xla_no_such_option": True, **right_options()}) == right_options()


@pytest.fixture
def fused(monkeypatch):
    """Names of the programs with a fusion for YNNPACK that are compiled, or read from JAX's cache,
    meanwhile."""
    found = []
    compile_one = compiler.compile_or_get_cached

    def watch(*arguments, **named):
        executable = compile_one(*arguments, **named)
        text = executable.hlo_modules()[0].to_string()
        if "__ynn_fusion" in text:
            found.append(re.match(r"HloModule (\w+)", text)[1])
        return executable

    monkeypatch.setattr(compiler, "compile_or_get_cached", watch)
    jax.clear_caches()
    return found


def solved(**how):
    support.solve(support.tiny(), max_iterations=1, **how)


def gradient():
    problem = support.tiny()

    def loss(inputs):
        return jnp.sum(
            differentiable_solve(problem, "ceres", SolveOptions(max_iterations=1))(inputs)[1] ** 2
        )

    jax.grad(loss)(jax.tree.map(jnp.asarray, inputs_of(problem)))


def play():
    game = GymVectorGame(tiny_game())
    game.reset(seed=0)
    game.step(game.action_space.sample())


def learn():
    sac = SacConfig(width=16, batch=64)
    loop = LoopConfig(replay_capacity=300, updates_per_step=2, steps_per_chunk=2)
    run_chunk(sac, loop, toys.ACTION, start(sac, loop, toys.ACTION, jax.random.key(0)))


@on_a_cpu
@pytest.mark.slow
@pytest.mark.parametrize(
    "run",
    [
        lambda: solved(policy="ceres", compilation="full"),
        lambda: solved(policy="bold", callback=lambda record: None),
        lambda: solved(policy="bold", linear_solver="implicit", compilation="full"),
        lambda: solved(policy="ceres", method="stba", compilation="full"),
        lambda: solved(policy="ceres", method="deeplm", compilation="full"),
        lambda: solve(support.odd(), "ceres", SolveOptions(max_iterations=1)),
        lambda: solve(
            support.whitened(), "ceres", SolveOptions(loss=Loss("huber", 1.0), max_iterations=1)
        ),
        lambda: solve_and_retriangulate(support.tiny(), "ceres", SolveOptions(max_iterations=1)),
        lambda: covariance(hold(support.tiny(), poses=[0, 1])),
        gradient,
        play,
        learn,
    ],
)
def test_no_program_of_ours_has_a_fusion_for_ynnpack(run, fused):
    run()
    assert fused == []


@on_a_cpu
def test_a_program_of_jax_has_such_fusions(fused):
    """The control of the test above."""
    jax.jit(lambda x: squares(x))(np.ones((1000, 3)))
    assert fused == ["jit__lambda"] or not known_options(RIGHT)
