"""Compiled programs on disk: a later process finds them, runs the same ones, and confuses none with
another."""

from __future__ import annotations

import dataclasses
import functools
import json
import lzma
import os
import pickle
import subprocess
import sys
import time
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from compilations import Compilations
from jax import monitoring
from jax.experimental.compilation_cache import compilation_cache
from support import solve

import jaxba
from jaxba import Loss, Tolerances, make_policy, register_pytree
from jaxba.io import write_problem
from jaxba.lm.step import try_step
from jaxba.problem.options import Refinement, StepOptions
from jaxba.results.retriangulate import retriangulate
from jaxba.runtime import compilation, executable_cache
from jaxba.runtime.compilation import ParallelCompilation, compile_and_run, program
from jaxba.solver import sharded, stepwise

pytestmark = [
    pytest.mark.xla,
    pytest.mark.skipif(jax.default_backend() != "cpu", reason="tried on a CPU alone"),
]


@pytest.fixture(autouse=True)
def folder(tmp_path):
    """The folder of the cache; JAX's own is switched off."""
    cache = jax.config.values["jax_compilation_cache_dir"]
    use_cache_of_jax(None)
    compilation.use_cache(tmp_path)
    yield tmp_path
    compilation.use_cache(None)
    use_cache_of_jax(cache)


def use_cache_of_jax(folder):
    jax.config.update("jax_compilation_cache_dir", folder)
    compilation_cache.reset_cache()  # it keeps the folder that it has opened
    jax.clear_caches()


def forget():
    """Drops what a new process would not have in memory."""
    jax.clear_caches()
    executable_cache._load.cache_clear()


def kept(folder):
    return sorted(folder.glob(f"*{executable_cache.SUFFIX}"))


def double(x, power):
    return 2 * x**power


double.__module__ = "jaxba.somewhere"  # functions of other packages are not stored


class Rule(NamedTuple):
    """A pytree of a user."""

    value: jax.Array


@dataclasses.dataclass(frozen=True)
class Choice:
    number: int = 1


def call(x, power=1):
    return compile_and_run(program(double, "power"), x, power)


@pytest.mark.parametrize(
    "how",
    [
        pytest.param({"policy": "ceres+embedded", "compilation": "auto"}, marks=pytest.mark.slow),
        {"policy": "ceres", "dtype": "mixed"},
        {"policy": "ceres+embedded", "method": "stba"},
        pytest.param({"policy": "ceres", "linear_solver": "implicit"}, marks=pytest.mark.slow),
        pytest.param({"policy": "ceres+embedded", "pad": True}, marks=pytest.mark.slow),
    ],
    ids=str,
)
def test_a_second_solve_reads_all_its_programs_and_repeats_itself_bit_by_bit(how, folder):
    def once():
        return solve(support.tiny(), **how, max_iterations=4, callback=lambda record: None)

    first = once()
    count = len(kept(folder))
    assert count >= 5
    forget()
    with Compilations() as seen:
        again = once()
    parts = (
        "state_of",
        "problem_info",
        "begin",
        "propose",
        "try_step",
        "try_candidate",
        "camera_round",
        "take_step",
        "_advance_and_pack",
    )
    assert not set(seen.names) & set(parts)
    assert len(kept(folder)) == count
    assert support.same_bits(first.history, again.history)
    assert support.same_bits(first.problem, again.problem)


@pytest.mark.slow
def test_a_second_solve_in_parts_reads_its_programs_and_repeats_itself_bit_by_bit(
    folder, monkeypatch
):
    problem = support.tiny()
    for name, value in (
        ("LARGE", 1),
        ("PART", problem.num_observations // 3),
        ("PART_OF_CAMERA", 0),
    ):
        monkeypatch.setattr(sharded, name, value)
    first = solve(problem, "ceres", linear_solver="implicit", max_iterations=3)
    assert [path.name.partition("-")[0] for path in kept(folder)] == ["_begin", "_run"]
    forget()
    with Compilations() as seen:
        again = solve(problem, "ceres", linear_solver="implicit", max_iterations=3)
    assert not {"_begin", "_run"} & set(seen.names)
    assert support.same_bits(first.history, again.history)
    assert support.same_bits(first.problem, again.problem)


def test_nothing_that_is_read_can_run_code_of_its_own(folder, monkeypatch):
    def once():
        return solve(support.tiny(), "ceres", max_iterations=2, callback=lambda record: None)

    expected = once().history
    forget()
    for name in ("load", "loads", "Unpickler"):
        monkeypatch.setattr(pickle, name, None)
    with Compilations() as seen:
        chex.assert_trees_all_equal(once().history, expected)
    assert not {"propose", "try_step"} & set(seen.names)
    file = kept(folder)[0]
    for kind in ("builtins.print", "os.system", "jaxba.solver.solve.solve"):
        header = json.dumps({"class": kind, "parts": []}).encode()
        file.write_bytes(lzma.compress(header + b"\n"))
        forget()
        assert executable_cache.ExecutableCache(folder).load(file) is None


@pytest.mark.slow
def test_a_problem_that_shares_some_programs_compiles_each_other_one_once(folder):
    def once(problem):
        return solve(problem, "ceres", max_iterations=2, callback=lambda record: None)

    once(support.tiny())
    forget()
    with Compilations() as seen:
        once(support.paper(1))
    compiled = [
        name for name in seen.names if name in ("begin", "_advance_and_pack", "propose", "try_step")
    ]
    assert sorted(compiled) == ["propose", "try_step"]


def test_retriangulation_is_stored_too(folder):
    first = retriangulate(support.tiny())
    assert len(kept(folder)) == 1
    forget()
    with Compilations() as seen:
        again = retriangulate(support.tiny())
    assert "_search" not in seen.names
    chex.assert_trees_all_equal(first.problem, again.problem, strict=True)


COUNTING = """
import sys
from jax import monitoring
names = []

def listen(event, _, **facts):
    if "compile/jaxpr_trace" in event:
        names.append(facts.get("fun_name"))

monitoring.register_event_duration_secs_listener(listen)
from jaxba.cli.solve import run
status = run(sys.argv[1:])
print("traced", sum(str(name) in ("propose", "try_candidate") for name in names))
sys.exit(status)
"""


def test_what_a_solve_ran_quickly_compiled_is_fully_optimised_in_the_next(folder, monkeypatch):
    """Another process compiles it after the solve; the second solve differs by rounding alone."""
    monkeypatch.setattr(stepwise, "WORTH_S", 0.0)
    problem = support.tiny()

    def once():
        return solve(
            problem, "ceres", max_iterations=4, compilation="auto", tolerances=Tolerances(ftol=0)
        )

    first = once()
    assert first.quick_iterations == 4
    before = len(kept(folder))
    limit = time.monotonic() + 60
    while len(kept(folder)) < before + 2 and time.monotonic() < limit:  # propose and try_step
        time.sleep(0.1)
    forget()
    with Compilations() as seen:
        again = once()
    assert again.quick_iterations == 0
    assert not {"propose", "try_step"} & set(seen.names)
    np.testing.assert_allclose(again.history.cost, first.history.cost, rtol=1e-9)
    forget()
    assert solve(problem, "ceres", max_iterations=4, compilation="quick").quick_iterations > 0


@pytest.mark.slow
def test_a_second_call_of_the_command_traces_no_step_and_writes_the_same_file(tmp_path):
    problem = tmp_path / "tiny.txt"
    folder = tmp_path / "cache"
    write_problem(support.tiny(), problem)
    ends = []
    for turn in range(2):
        output = tmp_path / f"{turn}.txt"
        command = [
            sys.executable,
            "-c",
            COUNTING,
            str(problem),
            "--output",
            str(output),
            "--compilation",
            "quick",
        ]
        environment = {**os.environ, "JAXBA_CACHE": str(folder)}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        printed = subprocess.run(
            command, env=environment, check=True, capture_output=True, text=True
        ).stdout
        ends.append((printed.splitlines()[-1], output.read_bytes()))
    assert ends[0][0] != "traced 0"
    assert ends[1][0] == "traced 0"
    assert ends[0][1] == ends[1][1]


@pytest.mark.parametrize(
    "content", [b"", b"no program", None], ids=["empty", "something else", "cut off"]
)
def test_a_damaged_file_is_compiled_and_written_again(content, folder):
    x = jnp.arange(3.0)
    expected = np.asarray(call(x))
    (file,) = kept(folder)
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if content is None else content)
    forget()
    np.testing.assert_array_equal(call(x), expected)
    forget()
    with Compilations() as seen:
        np.testing.assert_array_equal(call(x), expected)
    assert "double" not in seen.names


def test_everything_that_changes_a_program_changes_its_file(folder, monkeypatch):
    cache = executable_cache.ExecutableCache(folder)
    x = jnp.arange(3.0)
    path = functools.partial(cache.path_for, double, {"power": 1}, (x,))
    layout, _ = support.start(support.tiny())
    fewer = dataclasses.replace(layout, buckets=layout.buckets[1:])
    learned = make_policy("learned")
    stricter = dataclasses.replace(
        learned, config=dataclasses.replace(learned.config, min_gain=0.2)
    )
    others = [
        cache.path_for(try_step, {"power": 1}, (x,)),
        *(cache.path_for(double, {}, (tree,)) for tree in (layout, fewer, learned, stricter)),
        cache.path_for(double, {"power": 2}, (x,)),
        cache.path_for(double, {"power": StepOptions()}, (x,)),
        cache.path_for(double, {"power": StepOptions(refinement=Refinement(trials=2))}, (x,)),
        cache.path_for(double, {"power": 1}, (x.astype(jnp.float32),)),
        cache.path_for(double, {"power": 1}, (jnp.arange(4.0),)),
        cache.path_for(double, {"power": 1}, (1.0,)),
        cache.path_for(double, {"power": 1}, ((x,),)),
        path({"xla_backend_optimization_level": 0}),
    ]
    with jax.enable_x64(False):
        others.append(path())
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        others.append(path())
    with monkeypatch.context() as patch:
        patch.setattr(executable_cache, "_source", lambda: "another version of this package")
        others.append(executable_cache.ExecutableCache(folder).path_for(double, {"power": 1}, (x,)))
    assert len({path(), *others}) == 1 + len(others)
    assert path() == cache.path_for(double, {"power": 1}, (jax.ShapeDtypeStruct((3,), x.dtype),))


@pytest.mark.parametrize(
    "setting", ["jax_cpu_enable_async_dispatch", "jax_platforms", "jax_log_compiles"]
)
def test_commands_and_python_find_the_same_programs(folder, monkeypatch, setting):
    cache = executable_cache.ExecutableCache(folder)
    before = cache.path_for(double, {}, (jnp.arange(3.0),))
    monkeypatch.setitem(jax.config.values, setting, "another value")
    assert cache.path_for(double, {}, (jnp.arange(3.0),)) == before


@pytest.mark.parametrize(
    ("function", "static", "argument"),
    [
        (double, {"power": abs}, 1.0),
        (double, {"power": lambda: 0}, 1.0),
        (double, {"power": Choice()}, 1.0),
        (double, {"power": (1, Choice())}, 1.0),
        (double, {"power": StepOptions(loss=Loss(abs))}, 1.0),
        (double, {"power": 1}, Rule(1.0)),
        (double, {"power": 1}, [Rule(1.0)]),
        (call, {"power": 1}, 1.0),
        (lambda x: x, {}, 1.0),
    ],
    ids=[
        "builtin",
        "lambda",
        "class",
        "inside",
        "loss",
        "tree",
        "in a tree",
        "function",
        "nameless",
    ],
)
def test_programs_with_code_of_other_packages_are_not_stored(function, static, argument, folder):
    assert executable_cache.ExecutableCache(folder).path_for(function, static, (argument,)) is None


@pytest.mark.slow
def test_a_users_residual_is_known_by_what_it_does(folder):
    def registered(scale: float) -> jaxba.BundleProblem:
        @jaxba.residual
        def near(point, *, at):
            return scale * (point - at)

        return jaxba.with_residual(support.tiny(), near(point=[0, 1], at=0.0))

    def jitted(scale: float) -> jaxba.BundleProblem:
        table = np.arange(3.0) * scale
        inner = jax.jit(lambda point: point - table)

        @jaxba.residual
        def near(point, *, at):
            return inner(point) - at

        return jaxba.with_residual(support.tiny(), near(point=[0, 1], at=0.0))

    known = [jitted(scale).residuals.rows[0].residual.source for scale in (1.0, 1.0, 2.0)]
    assert known[0] == known[1] != known[2]

    def path(scale):
        return executable_cache.ExecutableCache(folder).path_for(
            try_step, {}, (registered(scale).residuals,)
        )

    assert path(1.0) is not None
    assert path(1.0) == path(1.0) != path(2.0)
    unregistered = jaxba.residual(lambda point, *, at: point - at)(point=[0], at=0.0)
    assert executable_cache.ExecutableCache(folder).path_for(try_step, {}, (unregistered,)) is None


def test_two_rules_of_a_user_are_not_confused(folder):
    def rule(factor):
        @register_pytree
        @dataclasses.dataclass(frozen=True)
        class Constant(type(make_policy("constant:1e-3"))):
            def propose(self, state, step):
                return state, factor * step.damping

        base = make_policy("constant:1e-3")
        return Constant(
            **{field.name: getattr(base, field.name) for field in dataclasses.fields(base)}
        )

    for factor in (0.5, 2.0):
        forget()
        solved = solve(support.tiny(), rule(factor), max_iterations=3, callback=lambda record: None)
        np.testing.assert_allclose(
            solved.history.damping[1:] / solved.history.damping[:-1], factor, rtol=1e-12
        )
    names = {file.name.partition("-")[0] for file in kept(folder)}
    assert {"propose", "try_step"} <= names
    assert not {"begin", "_advance_and_pack"} & names


def test_a_program_that_cannot_run_is_compiled_and_written_again(folder):
    call(jnp.arange(4.0))
    (other,) = kept(folder)
    content = other.read_bytes()
    expected = np.asarray(call(jnp.arange(3.0)))
    (file,) = set(kept(folder)) - {other}
    file.write_bytes(content)  # can be read, but is for four numbers
    forget()
    np.testing.assert_array_equal(call(jnp.arange(3.0)), expected)
    assert not file.exists()
    forget()
    np.testing.assert_array_equal(call(jnp.arange(3.0)), expected)
    assert file.exists()


def test_a_program_from_the_cache_of_jax_is_not_written(folder, tmp_path):
    use_cache_of_jax(str(tmp_path / "of-jax"))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    hits = []

    def listen(event, **_):
        return hits.append(event) if event == "/jax/compilation_cache/cache_hits" else None

    monitoring.register_event_listener(listen)
    try:
        call(jnp.arange(3.0))
        jax.config.update("jax_compilation_cache_dir", None)  # what it has opened stays open
        # the folder's name is part of the key of some versions of JAX: then the first is compiled
        for _ in range(2):
            forget()
            for file in kept(folder):
                file.unlink()
            hits.clear()
            np.testing.assert_array_equal(call(jnp.arange(3.0)), [0, 2, 4])
        assert hits
        assert not kept(folder)
    finally:
        monitoring.unregister_event_listener(listen)
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def test_programs_of_both_levels_are_stored(folder, monkeypatch):
    monkeypatch.setattr("jaxba.solver.stepwise.quick_iterations", lambda kind, _: 1)

    def once():
        return solve(support.tiny(), "ceres", max_iterations=3, compilation="auto")

    first = once()
    assert first.quick_iterations == 1
    assert sum(file.name.startswith(("propose", "try_step")) for file in kept(folder)) == 4
    forget()
    with Compilations() as seen:
        again = once()
    assert not {"propose", "try_step"} & set(seen.names)
    np.testing.assert_allclose(again.history.cost, first.history.cost, rtol=1e-8)


def test_a_missing_folder_is_no_error(tmp_path):
    compilation.use_cache(tmp_path / "gone")
    np.testing.assert_array_equal(call(jnp.arange(3.0)), [0, 2, 4])


def test_nothing_is_stored_while_the_cache_of_jax_is_on(folder, tmp_path):
    use_cache_of_jax(str(tmp_path / "of-jax"))
    np.testing.assert_array_equal(call(jnp.arange(3.0)), [0, 2, 4])
    assert not kept(folder)


def test_the_least_recently_used_program_is_removed_first(folder, monkeypatch):
    for k in range(3):
        call(jnp.arange(3.0), k)
        for file in kept(folder):
            os.utime(file, (0, os.stat(file).st_mtime - 100))
    oldest = min(kept(folder), key=lambda file: file.stat().st_mtime)
    size = max(file.stat().st_size for file in kept(folder))
    monkeypatch.setattr(executable_cache, "LIMIT", 3 * size)
    forget()
    call(jnp.arange(3.0), 0)  # the oldest, used again
    assert oldest.stat().st_mtime == max(file.stat().st_mtime for file in kept(folder))
    call(jnp.arange(3.0), 3)
    assert len(kept(folder)) == 3
    assert oldest.exists()


def test_a_static_argument_may_stand_anywhere(folder):
    def third(x, power, y):
        return x**power + y

    third.__qualname__ = "third"
    third.__module__ = "jaxba.somewhere"
    function = program(third, "power")
    for _ in range(2):
        with ParallelCompilation() as compile_programs:
            out = compile_programs(function, jnp.arange(3.0), 2, jnp.ones(3))
        assert (out.shape, out.dtype) == ((3,), jnp.float64)
        np.testing.assert_array_equal(
            compile_programs.run(function, jnp.arange(3.0), 2, jnp.ones(3)), [1, 2, 5]
        )
        forget()
    assert len(kept(folder)) == 1
