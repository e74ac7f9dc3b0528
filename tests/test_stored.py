"""Compiled programs on disk: a later process finds them, runs the same ones, and mistakes none for another."""

from __future__ import annotations

import functools
import os
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from test_programs import Compilations

from jaxba import programs, solve, stored
from jaxba.io import write_problem
from jaxba.options import StepOptions
from jaxba.programs import CompiledTogether, program, run_alone
from jaxba.retriangulate import retriangulate

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="tried on a CPU alone")


@pytest.fixture(autouse=True)
def folder(tmp_path):
    """Where programs are kept, and not in JAX's cache."""
    cache = jax.config.jax_compilation_cache_dir
    jax.config.update("jax_compilation_cache_dir", None)
    jax.clear_caches()  # what came from JAX's cache cannot be written
    programs.keep_in(tmp_path)
    yield tmp_path
    programs.keep_in(None)
    jax.config.update("jax_compilation_cache_dir", cache)


def forget():
    """What a new process does not know."""
    jax.clear_caches()
    stored._load.cache_clear()


def kept(folder):
    return sorted(folder.glob(f"*{stored.ENDING}"))


def double(x, power):
    return 2 * x**power


def call(x, power=1):
    return run_alone(program(double, "power"), x, power)


@pytest.mark.parametrize(
    "how",
    [
        {"damping": "learned", "compilation": "auto"},
        {"damping": "ceres", "dtype": "mixed"},
        {"damping": "learned", "dtype": "float32"},
        {"damping": "learned", "method": "stba"},
        {"damping": "learned", "method": "ddlm"},
        {"damping": "learned", "method": "deeplm"},
        {"damping": "learned", "linear_solver": "sparse"},
        {"damping": "ceres", "linear_solver": "implicit"},
        {"damping": "ceres", "method": "poba"},
        {"damping": "learned", "pad": True},
    ],
    ids=str,
)
def test_every_solve_finds_all_its_programs_and_repeats_itself_bit_by_bit(how, folder):
    once = lambda: solve(support.tiny(), **how, max_iterations=4, callback=lambda record: None)
    first = once()
    count = len(kept(folder))
    assert count >= 5
    forget()
    with Compilations() as seen:
        again = once()
    parts = ("initial_state", "problem_info", "begin", "effort_of", "propose", "judge", "lm_step", "_advance_and_tell")
    assert not set(seen.names) & set(parts)
    assert len(kept(folder)) == count
    assert support.same_bits(first.history, again.history)
    assert support.same_bits(first.problem, again.problem)


def test_a_search_for_points_is_kept_too(folder):
    first = retriangulate(support.tiny())
    assert len(kept(folder)) == 1
    forget()
    with Compilations() as seen:
        again = retriangulate(support.tiny())
    assert "_search" not in seen.names
    assert support.same_bits(first.problem, again.problem)


COUNTING = """
import sys
from jax import monitoring
names = []
monitoring.register_event_duration_secs_listener(
    lambda event, _, **facts: names.append(facts.get("fun_name")) if "compile/jaxpr_trace" in event else None
)
from jaxba.cli.solve import run
status = run(sys.argv[1:])
print("traced", sum("judge" in str(name) or "propose" in str(name) for name in names))
sys.exit(status)
"""


@pytest.mark.slow
def test_a_second_call_of_the_command_traces_no_step_and_writes_the_same_file(tmp_path):
    problem, folder = tmp_path / "tiny.txt", tmp_path / "cache"
    write_problem(support.tiny(), problem)
    ends = []
    for turn in range(2):
        output = tmp_path / f"{turn}.txt"
        command = [sys.executable, "-c", COUNTING, str(problem), "--output", str(output)]
        environment = {**os.environ, "JAXBA_CACHE": str(folder)}
        environment.pop("JAX_COMPILATION_CACHE_DIR", None)
        told = subprocess.run(command, env=environment, check=True, capture_output=True, text=True).stdout
        ends.append((told.splitlines()[-1], output.read_bytes()))
    assert ends[0][0] != "traced 0"
    assert ends[1][0] == "traced 0"
    assert ends[0][1] == ends[1][1]


@pytest.mark.parametrize("content", [b"", b"no program", None], ids=["empty", "something else", "cut off"])
def test_a_damaged_file_costs_a_compilation_and_is_mended(content, folder):
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


def test_another_question_is_another_program(folder, monkeypatch):
    store = stored.Store(folder)
    x = jnp.arange(3.0)
    place = functools.partial(store.place, double, {"power": 1}, (x,))
    others = [
        store.place(call, {"power": 1}, (x,)),
        store.place(double, {"power": 2}, (x,)),
        store.place(double, {"power": StepOptions()}, (x,)),
        store.place(double, {"power": StepOptions(trials=2)}, (x,)),
        store.place(double, {"power": 1}, (x.astype(jnp.float32),)),
        store.place(double, {"power": 1}, (jnp.arange(4.0),)),
        store.place(double, {"power": 1}, (1.0,)),
        store.place(double, {"power": 1}, ((x,),)),
        place({"xla_backend_optimization_level": 0}),
    ]
    with jax.enable_x64(False):
        others.append(place())
    with monkeypatch.context() as patch:
        patch.setenv("XLA_FLAGS", "--xla_cpu_enable_fast_math=true")
        others.append(place())
    with monkeypatch.context() as patch:
        patch.setattr(stored, "_source", lambda: "another version of this package")
        others.append(place())
    with monkeypatch.context() as patch:
        patch.setattr(stored, "_machine", lambda: "another machine")
        others.append(place())
    assert len({place(), *others}) == 1 + len(others)
    assert place() == store.place(double, {"power": 1}, (jax.ShapeDtypeStruct((3,), x.dtype),))


def test_what_has_no_lasting_name_is_not_kept(folder):
    assert stored.Store(folder).place(double, {"power": lambda: 0}, (jnp.arange(3.0),)) is None
    assert run_alone(program(lambda x: x + 1), 1) == 2
    assert not kept(folder)


def test_a_folder_that_is_gone_costs_time_and_nothing_else(tmp_path):
    programs.keep_in(tmp_path / "gone")
    np.testing.assert_array_equal(call(jnp.arange(3.0)), [0, 2, 4])


def test_beside_the_cache_of_jax_nothing_is_kept(folder, tmp_path):
    jax.config.update("jax_compilation_cache_dir", str(tmp_path / "of-jax"))
    np.testing.assert_array_equal(call(jnp.arange(3.0)), [0, 2, 4])
    assert not kept(folder)


def test_what_was_not_used_for_longest_goes_first(folder, monkeypatch):
    for k in range(3):
        call(jnp.arange(3.0), k)
        for file in kept(folder):
            os.utime(file, (0, os.stat(file).st_mtime - 100))
    oldest = min(kept(folder), key=lambda file: file.stat().st_mtime)
    size = max(file.stat().st_size for file in kept(folder))
    monkeypatch.setattr(stored, "LIMIT", 3 * size)
    forget()
    call(jnp.arange(3.0), 0)  # the oldest, used again
    assert oldest.stat().st_mtime == max(file.stat().st_mtime for file in kept(folder))
    call(jnp.arange(3.0), 3)
    assert len(kept(folder)) == 3
    assert oldest.exists()


def test_a_program_is_run_with_any_static_argument_in_any_place(folder):
    def third(x, power, y):
        return x**power + y

    third.__qualname__ = "third"
    function = program(third, "power")
    for _ in range(2):
        with CompiledTogether() as together:
            out = together(function, jnp.arange(3.0), 2, jnp.ones(3))
        assert (out.shape, out.dtype) == ((3,), jnp.float64)
        np.testing.assert_array_equal(together.run(function, jnp.arange(3.0), 2, jnp.ones(3)), [1, 2, 5])
        forget()
    assert len(kept(folder)) == 1
