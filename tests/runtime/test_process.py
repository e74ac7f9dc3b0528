"""Memory, threads and memory mappings of the process."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest
from support import solve, tiny

from jaxba.runtime import process

linux = pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="only Linux reports the mappings of a process"
)


def mappings() -> int:
    return len(Path("/proc/self/maps").read_text().splitlines())


@pytest.mark.xla
@linux
def test_programs_are_dropped_near_the_limit_and_only_there():
    @jax.jit
    def twice(x):
        return 2 * x

    twice(jnp.ones(3))
    assert not process.release_programs(share=1.0)
    assert twice._cache_size() == 1
    assert process.release_programs(share=0.0)
    assert twice._cache_size() == 0
    assert twice(jnp.ones(3))[0] == 2


@linux
def test_dropping_programs_gives_their_mappings_back():
    process.release_programs(share=0.0)
    before = mappings()
    solve(tiny(), max_iterations=1)  # some 500
    during = mappings()
    assert process.release_programs(share=0.0)
    assert mappings() - before < 0.5 * (during - before)


def test_only_a_solve_that_compiled_checks_the_mappings(monkeypatch):
    called = []
    monkeypatch.setattr(process, "release_programs", lambda: called.append(1))
    jax.clear_caches()
    solve(tiny(), max_iterations=2)
    assert len(called) == 1
    solve(tiny(), max_iterations=2)
    assert len(called) == 1


ARENAS = """
import ctypes, sys, threading
from jaxba.runtime import process
if not process.keep_memory():
    sys.exit(3)  # no glibc
import jax
assert not jax.config.values["jax_cpu_enable_async_dispatch"]
libc = ctypes.CDLL(None)
libc.malloc.restype = libc.fopen.restype = ctypes.c_void_p
both = threading.Barrier(2)
def work():
    libc.malloc(1000)
    both.wait()  # a thread that ends hands its arena on
threads = [threading.Thread(target=work) for _ in range(2)]
for thread in threads: thread.start()
for thread in threads: thread.join()
file = ctypes.c_void_p(libc.fopen(sys.argv[1].encode(), b"w"))
libc.malloc_info(0, file)
libc.fclose(file)
"""


@linux
def test_threads_that_compile_have_arenas_of_their_own_while_memory_is_kept(tmp_path):
    report = tmp_path / "arenas.xml"
    status = subprocess.run([sys.executable, "-c", ARENAS, str(report)], check=False).returncode
    if status == 3:
        pytest.skip("only glibc has arenas")
    assert status == 0
    assert report.read_text().count("<heap nr=") > 1
