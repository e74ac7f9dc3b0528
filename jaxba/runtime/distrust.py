"""What a command does where XLA distrusts the programs of the cache that were compiled on the same machine.

On some Intel processors XLA notes preferences of its compiler (`+prefer-no-gather`) as instructions that a program
needs, then misses them in the machine, says so for every program that it reads, and may compile them all anew
(jax-ml/jax#38445); and where instructions really are missing, the process dies by SIGILL. With
`--xla_cpu_max_isa=AVX2` programs need neither. As an option of a single program that changes nothing (jaxlib 0.10.2),
so it is a flag of the process, which a command may set for itself and a library may not.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import os
import platform
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from jaxba.runtime.atomic import atomic_write

FLAG = "--xla_cpu_max_isa"

COMPLAINT = b"doesn't match the machine type for execution"
"""What XLA writes to standard error, and no function returns."""

MARK, RUNNING = ".avx2", ".running"
"""Endings of files beside the programs: the decision for a machine; and a process that runs a program from the cache
for the first time, which is left behind only by one that has died of it."""


def limit_instructions(folder: Path) -> None:
    """Sets XLA's flag if programs of this folder were refused before on this machine. Before JAX's backend starts."""
    for file in folder.glob(f"{_machine()}-*{RUNNING}"):
        if not _is_alive(int(file.stem.rpartition("-")[2])):
            _decide(folder, "a process died of a compiled program in")
            file.unlink(missing_ok=True)
    flags = os.environ.get("XLA_FLAGS", "")
    if FLAG not in flags and (folder / f"{_machine()}{MARK}").exists():
        os.environ["XLA_FLAGS"] = f"{flags} {FLAG}=AVX2".strip()


@contextlib.contextmanager
def reading(folder: Path) -> Iterator[None]:
    """While a program is read: hears what XLA says of it on standard error, and passes that on only if it is else."""
    if FLAG in os.environ.get("XLA_FLAGS", "") or sys.__stderr__ is None:
        yield
        return
    with tempfile.TemporaryFile() as heard:
        kept = os.dup(2)
        os.dup2(heard.fileno(), 2)
        try:
            yield
        finally:
            os.dup2(kept, 2)
            os.close(kept)
            heard.seek(0)
            lines = heard.read().splitlines(keepends=True)
            others = [line for line in lines if COMPLAINT not in line]
            os.write(2, b"".join(others))
            if len(others) < len(lines):
                _decide(folder, "XLA refuses the compiled programs in")


@contextlib.contextmanager
def first_run(folder: Path) -> Iterator[None]:
    """While a program from the cache runs for the first time: what is left of it tells the next process of a crash."""
    file = folder / f"{_machine()}-{os.getpid()}{RUNNING}"
    with contextlib.suppress(OSError):
        file.touch()
    try:
        yield
    finally:
        with contextlib.suppress(OSError):
            file.unlink()


def _decide(folder: Path, reason: str) -> None:
    mark = folder / f"{_machine()}{MARK}"
    if mark.exists():
        return
    with contextlib.suppress(OSError), atomic_write(mark) as file:
        file.write(b"")
    print(f"note: {reason} {folder}: from now on programs are compiled with {FLAG}=AVX2", file=sys.stderr)


def _is_alive(process: int) -> bool:
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    except OSError:  # another user's
        return True
    return True


@functools.cache
def _machine() -> str:
    """A name for this machine and its instructions, found without JAX."""
    return hashlib.sha256("\n".join([platform.node(), *processor_features()]).encode()).hexdigest()[:16]


def processor_features() -> list[str]:
    """Lines of instructions that the processors have, if the system tells them."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.is_file() else []
    return sorted({line for line in lines if line.startswith(("flags", "Features"))})
