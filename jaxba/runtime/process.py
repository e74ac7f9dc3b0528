"""Memory, threads and memory mappings of the process, set so that XLA on a CPU is fast and does not
run out of them.

The commands use all of these; a library user may."""

from __future__ import annotations

import contextlib
import ctypes
import functools
import gc
import importlib.util
import os
import sys
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import threadpoolctl
from threadpoolctl import ThreadpoolController

T = TypeVar("T")

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX = -1, -2, -4  # parameter numbers of glibc's mallopt (malloc.h)
# share of the limit of mappings at which programs are dropped; sixteen solvers took a tenth
MAPPINGS_SHARE = 0.4
# growth, as such a share, below which they are not dropped again: mappings that are not JAX's stay
GROWTH_SHARE = 0.1
_mappings_left = 0  # mappings that were left when programs were dropped last


def threads() -> int:
    """Number of processor cores that this process may use."""
    return (
        len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else (os.cpu_count() or 1)
    )


def keep_memory() -> bool:
    """Makes glibc keep freed memory instead of returning it to the system.

    XLA allocates the temporaries of a program anew at every call. Above 32 MiB glibc maps fresh
    pages for them each time, and the page faults cost more than the arithmetic. Memory then stays
    with the process until it ends.

    That holds for glibc's main arena, the one of the process's first thread; the arena of another
    thread holds 64 MiB and is returned when it empties. So XLA is set to run programs in the thread
    that calls them, which must be done before any program runs. (A single arena for all threads
    would do as well, but threads that compile would wait for each other: 7.8 s instead of 4.9 s for
    the step of `bold` on Ladybug-49.) Returns whether it took effect."""
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    import jax

    jax.config.update("jax_cpu_enable_async_dispatch", False)
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 64 << 20))
    return all(mallopt(parameter, value) == 1 for parameter, value in settings)


def memory() -> float:
    """Bytes of memory that this process may use: of the machine, or of its control group; infinite
    if not known."""
    try:
        found = float(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (AttributeError, ValueError, OSError):
        return np.inf
    with contextlib.suppress(OSError, ValueError):
        # a word if there is no limit
        found = min(found, float(Path("/sys/fs/cgroup/memory.max").read_text()))
    return found


def return_memory() -> None:
    """Gives the memory that was freed so far back to the system, where the C library is glibc."""
    with contextlib.suppress(OSError, AttributeError):
        ctypes.CDLL("libc.so.6").malloc_trim(0)


def out_of_memory(error: Exception) -> bool:
    """Whether Python, NumPy or XLA, on a CPU or a GPU, could not get memory."""
    return isinstance(error, MemoryError) or (
        type(error).__name__ in ("JaxRuntimeError", "XlaRuntimeError")
        and "RESOURCE_EXHAUSTED" in str(error)
    )


def missing_platform() -> str | None:
    """The platforms that JAX was told to use, as by JAX_PLATFORMS, if it cannot start them; else
    None."""
    import jax

    try:
        jax.devices()
    # the second, without a word, for cuda where JAX was installed without it
    except (RuntimeError, AssertionError):
        return jax.config.values.get("jax_platforms")
    return None


def release_programs(share: float | None = None) -> bool:
    """Drops JAX's compiled programs if the process comes near Linux's limit of memory mappings.

    XLA maps a few pages for every kernel of a program, some thousands for a solver and a problem.
    At `vm.max_map_count` (65,530 unless set) the next compilation ends the process with a
    segmentation fault, which a benchmark of fifteen problems and a dozen solvers reaches. A dropped
    program is read from the compilation cache, or compiled again, when it is needed again. `share`
    is that of the limit, from which on programs are dropped; `MAPPINGS_SHARE` if None. Returns
    whether they were dropped; false where the system does not report mappings."""
    global _mappings_left
    share = MAPPINGS_SHARE if share is None else share
    try:
        limit = int(Path("/proc/sys/vm/max_map_count").read_text())
        count = _mappings()
    except (OSError, ValueError):
        return False
    if count <= share * limit or (share and count < _mappings_left + GROWTH_SHARE * limit):
        return False
    import jax

    jax.clear_caches()
    for drop in _droppers:
        drop()
    gc.collect()
    _mappings_left = _mappings()
    return True


_droppers: list[Callable[[], object]] = []


def when_released(drop: Callable[[], object]) -> None:
    """Calls a function whenever `release_programs` drops programs, so that others are dropped,
    too."""
    _droppers.append(drop)


def _mappings() -> int:
    with Path("/proc/self/maps").open("rb") as file:
        return sum(1 for _ in file)


_blas_lock = threading.Lock()
_blas_users = 0  # contexts of `single_blas_thread` that are open, in all threads
_blas_limit: Any = None  # what the first of them has set, which the last takes back


@contextlib.contextmanager
def single_blas_thread() -> Iterator[None]:
    """A context in which BLAS uses one thread. Contexts of several threads may overlap.

    XLA on a CPU factors matrices with SciPy's OpenBLAS, whose threads keep spinning after each call
    and take the processor from XLA's own threads; beside another busy process an iteration became
    ten times slower."""
    global _blas_users, _blas_limit
    with _blas_lock:
        if not _blas_users:
            # loads the library whose threads are limited
            if "scipy.linalg.cython_lapack" not in sys.modules:
                importlib.import_module("scipy.linalg.cython_lapack")
            _blas_limit = _as_owner_of_blas(
                lambda: ThreadpoolController().limit(limits=1, user_api="blas")
            )
        _blas_users += 1
    try:
        yield
    finally:
        with _blas_lock:
            _blas_users -= 1
            if not _blas_users:
                _as_owner_of_blas(_blas_limit.restore_original_limits)


def _as_owner_of_blas(change: Callable[[], T]) -> T:
    """Changes BLAS's threads. In recent threadpoolctl the first thread that does so owns
    OpenBLAS's."""
    disown = getattr(
        getattr(threadpoolctl, "OpenBLASController", None),
        "clear_controlling_thread",
        lambda **_: None,
    )
    disown(force=True)
    changed = change()
    disown(force=True)
    return changed


_forked_from_jax = False  # whether this process is the fork of one in which JAX had started


def refuse_fork() -> None:
    """Raises a RuntimeError if this process is the fork of one in which JAX had started: it would
    wait for threads that only that one has. Known of forks after the import of this module."""
    if _forked_from_jax:
        raise RuntimeError(
            "this process was forked from one in which JAX had started, and would wait for its "
            "threads for ever: begin it anew, with "
            'multiprocessing.get_context("spawn") or '
            'gymnasium.vector.AsyncVectorEnv(..., context="spawn")'
        )


def _after_fork() -> None:
    global _forked_from_jax
    bridge = sys.modules.get("jax._src.xla_bridge")  # JAX has no public name for this
    started = getattr(bridge, "backends_are_initialized", lambda: bridge is not None)
    _forked_from_jax = _forked_from_jax or started()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_after_fork)


@functools.cache
def register_lapack() -> None:
    """Lets jaxlib look up LAPACK's routines in SciPy, which it does when it first lowers a call of
    one on a CPU. A compiled program from a file that calls one before would crash."""
    from jaxlib import lapack

    lapack.prepare_lapack_call("potrf_ffi", np.dtype("float64"))


def load_lapack() -> None:
    """Loads the BLAS and LAPACK of SciPy that XLA on a CPU calls, without the rest of
    `scipy.linalg`.

    The whole of it takes 0.15 s of a call that may take one second; jaxlib needs two of its
    modules, which take 0.01 s. Meanwhile an empty module stands in the place of their package, so
    this is for a command that has started no thread."""
    name = "scipy.linalg"
    spec = None if name in sys.modules else importlib.util.find_spec(name)
    if spec is None:
        return
    # knows where its modules are; none is imported
    sys.modules[name] = importlib.util.module_from_spec(spec)
    try:
        register_lapack()
    # a SciPy whose modules need more of the package; it is imported later, as usual
    except ImportError:
        register_lapack.cache_clear()
    finally:
        del sys.modules[name]


def user_cache(part: str) -> Path:
    """A folder of this package within the user's cache folder, as the XDG base directory
    specification has it."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "jaxba" / part
