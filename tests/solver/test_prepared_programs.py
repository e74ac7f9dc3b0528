"""Programs that are compiled before a solve wants them."""

from __future__ import annotations

import jax
import pytest
import support
from compilations import Compilations

from jaxba import SolveOptions, hold, prepare_programs, solve
from jaxba.runtime import compilation, executable_cache, program_cache
from jaxba.solver import prepared_programs
from jaxba.structure.padding import capacity_of

pytestmark = pytest.mark.skipif(jax.default_backend() != "cpu", reason="tried on a CPU alone")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A folder in which programs are kept, and not by JAX."""
    cache = jax.config.values["jax_compilation_cache_dir"]
    jax.config.update("jax_compilation_cache_dir", None)
    monkeypatch.setattr(program_cache, "_is_chosen", True)
    compilation.use_cache(tmp_path)
    yield tmp_path
    compilation.use_cache(None)
    jax.config.update("jax_compilation_cache_dir", cache)


def test_usual_problems_have_the_sizes_that_they_are_for():
    for cameras, slots in (*prepared_programs.SIZES, *prepared_programs.LOCAL_SIZES):
        capacity = capacity_of(prepared_programs.problem_of_size(cameras, slots))
        assert (capacity.cameras, capacity.observations) == (cameras, slots)


def test_a_call_tells_how_many_kinds_are_done(folder, monkeypatch):
    monkeypatch.setattr(prepared_programs, "_compile", lambda *_: None)
    seen = []
    problems = [support.tiny(), support.tiny()]
    assert prepare_programs(problems, progress=lambda *counts: seen.append(counts)) == 2
    assert seen == [(0, 2), (1, 2), (2, 2)]


def test_without_a_folder_for_programs_nothing_is_compiled(monkeypatch):
    monkeypatch.setenv("JAXBA_CACHE", "off")
    with pytest.raises(ValueError, match="no programs are kept on disk"):
        prepare_programs([support.tiny()])


@pytest.mark.slow
@pytest.mark.xla
def test_a_solve_of_a_prepared_kind_compiles_no_step_and_begins_with_optimised_programs(folder):
    prepared = hold(support.tiny(), points=[0])
    wanted = hold(support.tiny(), points=[1, 2], poses=[3])
    prepare_programs([prepared], "ceres+embedded")
    jax.clear_caches()
    executable_cache._load.cache_clear()
    with Compilations() as seen:
        solution = solve(
            wanted, "ceres+embedded", SolveOptions(max_iterations=3, compilation="auto", pad=True)
        )
    assert not {"propose", "try_candidate", "camera_round"} & set(seen.names)
    assert solution.quick_iterations == 0
