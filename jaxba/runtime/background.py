"""Programs that a later process will want, compiled by a process of their own after this one.

A call that ran quickly compiled programs for long leaves the fully optimised ones to such a
process. It has the lowest priority and one core, one at a time works for a folder of programs, and
the system ends it after `LIMIT_S` seconds of processor time. It gets what to compile through a
pipe; nothing that lies on disk is unpickled."""

from __future__ import annotations

import contextlib
import os
import pickle
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp

from jaxba.runtime import compilation
from jaxba.runtime.executable_cache import CACHE_SETTINGS
from jaxba.runtime.numerics import numerics

# seconds of processor time after which the process is ended. Those of kitti00vo take fifteen
LIMIT_S = 120
LOCK = "compiling"  # file of a folder of programs that the process holds locked


LOWEST_PRIORITY = 19  # of nice(2)


class Wanted(NamedTuple):
    """A program to compile fully, and the file that it belongs into."""

    function: Callable[..., Any]
    arguments: tuple[Any, ...]  # shapes and types in the place of arrays
    path: Path


def outline(arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    """The arguments with shapes and types in the place of arrays."""

    def typed(x):
        return jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=getattr(x, "weak_type", False))

    return jax.tree.map(lambda x: typed(x) if hasattr(x, "dtype") else x, arguments)


def compile_later(wanted: Sequence[Wanted]) -> None:
    """Begins to compile programs, all for one folder, in a process that outlives this one. Does
    nothing where that is not possible, as with a function of a user that cannot be pickled."""
    settings = {
        name: value
        for name, value in jax.config.values.items()
        if not name.startswith(CACHE_SETTINGS)
    }
    with contextlib.suppress(Exception):
        content = pickle.dumps((settings, jnp.result_type(float).name, list(wanted)))
        process = subprocess.Popen(
            [sys.executable, "-m", __name__],
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        _give_way(process.pid)
        assert process.stdin is not None
        with process.stdin as pipe:
            pipe.write(content)
        process.returncode = 0  # nobody waits for it, and Python need not warn of that


def _give_way(process: int) -> None:
    """Gives a process of a session of its own the lowest priority, and one core."""
    os.setpriority(os.PRIO_PROCESS, process, LOWEST_PRIORITY)
    # Linux shares the processor among sessions first (sched(7), autogroup), whatever the priorities
    # of their processes: a call right after another took 1.27 instead of 0.88 s to iterate
    with contextlib.suppress(OSError):
        Path(f"/proc/{process}/autogroup").write_text(str(LOWEST_PRIORITY))
    if hasattr(os, "sched_setaffinity"):  # one core: the next command may run at the same time
        os.sched_setaffinity(process, {max(os.sched_getaffinity(0))})


def _compile(settings: dict[str, Any], dtype: str, wanted: Sequence[Wanted]) -> None:
    for name, value in settings.items():
        if jax.config.values.get(name) != value:
            jax.config.update(name, value)
    compilation.use_cache(wanted[0].path.parent)
    with numerics(dtype), compilation.ParallelCompilation() as compile_programs:
        for function, arguments, path in wanted:
            one = compilation.program(function, "options", level="full")
            if compile_programs.path(one, *arguments) == path and not path.exists():
                compile_programs(one, *arguments)


def main() -> None:
    """Compiles what standard input asks for, unless another process is at it."""
    import fcntl  # Unix alone has these
    import resource

    resource.setrlimit(resource.RLIMIT_CPU, (LIMIT_S, LIMIT_S))
    settings, dtype, wanted = pickle.loads(sys.stdin.buffer.read())
    with (wanted[0].path.parent / LOCK).open("w") as lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            return
        _compile(settings, dtype, wanted)


if __name__ == "__main__":
    main()
