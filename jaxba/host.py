"""Settings of the process that make XLA on a CPU faster; the commands use them, a library user may."""

from __future__ import annotations

import contextlib
import ctypes
import sys
from collections.abc import Iterator

from threadpoolctl import ThreadpoolController

_TRIM_THRESHOLD, _TOP_PAD, _MMAP_MAX, _ARENA_MAX = -1, -2, -4, -8
"""Parameter numbers of glibc's mallopt (malloc.h)."""


def keep_memory() -> bool:
    """Tells glibc to keep freed memory instead of handing it back to the system.

    XLA allocates the temporaries of a program anew at every call. Above 32 MiB glibc maps fresh pages for them each
    time, and touching those costs more than the arithmetic (measured: docs/performance.md). Memory then stays with
    the process until it ends.

    Returns:
        Whether it took effect; false where the C library is another one.
    """
    if not sys.platform.startswith("linux"):
        return False
    try:
        mallopt = ctypes.CDLL(None).mallopt
    except (OSError, AttributeError):
        return False
    settings = ((_MMAP_MAX, 0), (_TRIM_THRESHOLD, 2**31 - 1), (_TOP_PAD, 64 << 20), (_ARENA_MAX, 1))
    return all(mallopt(parameter, value) == 1 for parameter, value in settings)


@contextlib.contextmanager
def calm_blas() -> Iterator[None]:
    """One BLAS thread for as long as the context is open.

    XLA on a CPU factors matrices with SciPy's OpenBLAS, whose threads keep spinning after each call. XLA's own threads
    then share the processor with them; beside another busy process an iteration became ten times slower
    (docs/performance.md).
    """
    import scipy.linalg.cython_lapack  # noqa: F401  # loads the library whose threads are limited

    with ThreadpoolController().limit(limits=1, user_api="blas"):
        yield
