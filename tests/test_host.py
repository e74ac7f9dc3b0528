"""Settings of the process."""

from __future__ import annotations

import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import pytest

from jaxba import host

linux = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="only Linux tells the mappings of a process")


def mappings() -> int:
    return len(Path("/proc/self/maps").read_text().splitlines())


@linux
def test_programs_are_dropped_near_the_limit_and_only_there():
    @jax.jit
    def twice(x):
        return 2 * x

    twice(jnp.ones(3))
    assert not host.release_programs(share=1.0)
    assert twice._cache_size() == 1
    assert host.release_programs(share=0.0)
    assert twice._cache_size() == 0
    assert twice(jnp.ones(3))[0] == 2


@linux
def test_dropping_programs_gives_their_mappings_back():
    def compile_some() -> None:
        for k in range(20):
            jax.jit(lambda x, k=k: jnp.linalg.cholesky(jnp.eye(3) + x * k) @ jnp.sin(x))(jnp.ones((3, 3)))

    host.release_programs(share=0.0)
    before = mappings()
    compile_some()
    during = mappings()
    assert host.release_programs(share=0.0)
    assert mappings() - before < 0.5 * (during - before)
