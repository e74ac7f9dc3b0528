"""Numbers are float64, types are checked where people call, and what was compiled once is kept for
the next session.

Programs are compiled without LLVM's optimisations, unless `--compilation full` is given: they
compute the same, and most of the time of all these tests is compilation. `.ci/run` has the slow
ones, and those of the step, compiled fully."""

from __future__ import annotations

import ast
import gc
import hashlib
import os
import platform
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import jax
import jaxtyping
import pytest
import threadpoolctl


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--compilation",
        choices=("quick", "full"),
        default="quick",
        help="how XLA compiles all programs (on a GPU: full)",
    )


def pytest_configure(config: pytest.Config) -> None:
    # a worker of pytest-xdist inherits the flags
    if config.getoption("compilation") == "quick" and not hasattr(config, "workerinput"):
        os.environ["XLA_FLAGS"] = (
            f"{os.environ.get('XLA_FLAGS', '')} {_flags_of_level_quick()}".strip()
        )
    # for workers, children, and what is imported from here on
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    jax.config.update("jax_enable_x64", True)
    jax.config.update("jax_num_cpu_devices", 3)
    cache = getattr(config, "cache", None)
    if cache is not None:
        folder = cache.mkdir(f"xla-{_machine()}")
    else:  # -p no:cacheprovider
        config.stash[_TEMPORARY] = tempfile.TemporaryDirectory(prefix="jaxba-tests-")
        folder = Path(config.stash[_TEMPORARY].name)
    jax.config.update("jax_compilation_cache_dir", str(folder))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.2)


def _flags_of_level_quick() -> str:
    """XLA's flags by which all programs of a process and its children have
    `compiler_options("quick")`, and more.

    XLA ends a process whose flags it does not know, so another process asks which ones it knows.
    That one may import jaxba, too: here it must not be imported before the import hook of jaxtyping
    is there."""
    code = (
        "from jaxba.runtime.compilation import compiler_options; from jaxba.runtime.jit import "
        "known_options; "
        # all in one piece: two workers on two cores gain nothing from compiling the pieces of a
        # program in parallel
        "print(compiler_options('quick') | known_options({'xla_cpu_parallel_codegen_split_count': "
        "1}))"
    )
    told = subprocess.run(
        [sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True
    ).stdout
    return " ".join(
        f"--{name}={str(value).lower()}" for name, value in ast.literal_eval(told).items()
    )


WHOLE_ROOMS = ("lm", "linear")
"""Of these rooms `-m sample` has the first case of each test, of the others the first test of each
file."""

LABORATORY = {"methods", "kitti", "game", "training", "peers", "bench", "paper"}
"""Rooms that ask rather than solve. The library, which is all else, imports nothing of them
(test_imports.py). Of each both samples have the first test."""


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    seen = set()
    for item in items:
        whole = item.path.parent.name in WHOLE_ROOMS
        marker = item.get_closest_marker("slow")
        slow = marker is not None
        if marker is not None and marker.args:
            continue
        test = (
            item.path.parent if item.path.parent.name in LABORATORY else item.path,
            slow,
            item.originalname if whole and not slow and isinstance(item, pytest.Function) else None,
        )
        if test not in seen:
            seen.add(test)
            item.add_marker(pytest.mark.slow_sample if slow else pytest.mark.sample)
    if config.getoption("compilation") == "full":
        return
    for item in items:
        if item.get_closest_marker("fully_compiled"):
            item.add_marker(pytest.mark.skip(reason="needs --compilation full, as in .ci/run"))


def pytest_collection_finish() -> None:
    """Python looks for garbage less often: it took a tenth of all tests, most of it in what was
    imported."""
    gc.set_threshold(50_000, 10, 10)


def pytest_unconfigure(config: pytest.Config) -> None:
    if _TEMPORARY in config.stash:
        config.stash[_TEMPORARY].cleanup()


_TEMPORARY: pytest.StashKey[tempfile.TemporaryDirectory] = pytest.StashKey()


def _machine() -> str:
    """Names this kind of processor: programs compiled for another one must not be run."""
    facts = platform.machine()
    cpus = Path("/proc/cpuinfo")
    if cpus.is_file():
        facts += "".join(
            sorted({line for line in cpus.read_text().splitlines() if line.startswith("flags")})
        )
    return hashlib.sha256(facts.encode()).hexdigest()[:12]


@pytest.fixture(scope="module", autouse=True)
def few_programs():
    """Many modules compile more programs than one process may map, or a small machine holds. Inside
    a module they stay, as far as they may, so that its tests can count them."""
    from jaxba.runtime import process  # here, so that the import hook of jaxtyping sees it

    share = process.MAPPINGS_SHARE
    process.MAPPINGS_SHARE = 0.8
    yield
    process.MAPPINGS_SHARE = share
    process.release_programs(0.2)


@pytest.fixture(scope="session", autouse=True)
def memory_is_given_back():
    """Commands that run in this process would set it to keep all memory that it frees, until it had
    gigabytes."""
    from jaxba.runtime import process

    keep = process.keep_memory
    process.keep_memory = lambda: False
    yield
    process.keep_memory = keep


@pytest.fixture(scope="session", autouse=True)
def one_blas_thread():
    """Beside another busy process several threads make a dense factorisation up to two hundred
    times slower: they wait by spinning."""
    with threadpoolctl.threadpool_limits(1, "blas"):
        yield


@pytest.fixture(scope="session", autouse=True)
def ctrl_c():
    """Ctrl-C has Python's handler, and so the system's in child processes, also where the shell
    that started pytest ignores it, as `nohup` and many job systems do."""
    ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    if ignored:
        signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    if ignored:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


@pytest.fixture
def unchecked():
    """Switches the type checks off: what a value of the wrong type does for a user, who has
    none."""
    jaxtyping.config.update("jaxtyping_disable", True)
    yield
    jaxtyping.config.update("jaxtyping_disable", False)
