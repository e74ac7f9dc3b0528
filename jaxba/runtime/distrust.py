"""Where compiled programs are kept, and what is done where XLA distrusts programs that it compiled
on the same machine.

On some Intel processors XLA notes preferences of its compiler (`+prefer-no-gather`) as instructions
that a program needs, then misses them in the machine, says so for every program that it reads, and
may compile them all anew (jax-ml/jax#38445). With `--xla_cpu_max_isa=AVX2` it does not. As an
option of a single program that changes nothing (jaxlib 0.10.2), so it is a flag of the process,
which a command may set for itself and a library may not."""

from __future__ import annotations

import hashlib
import os
import platform
import sys
import tempfile
from pathlib import Path
from typing import Any

import jax
import jaxlib
from jax.experimental.serialize_executable import deserialize_and_load, serialize

from jaxba.runtime.atomic import write_text
from jaxba.runtime.jit import jit

FLAG = "--xla_cpu_max_isa"

# what XLA writes to standard error alone
COMPLAINT = b"doesn't match the machine type for execution"
DECISION = "instructions"  # name of the file that says what programs of a folder are compiled for


def programs_folder(parent: Path) -> Path:
    """The folder of the programs of these processors and this jaxlib; foreign ones could end the
    process.

    The first command on a machine tries whether XLA distrusts its own programs, says so, and notes
    it in a file there. Then this and all later commands set XLA's flag, for which JAX's backend
    must not have started; for the first one it comes too late. Raises OSError: the folder cannot be
    written."""
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.is_file() else []
    features = sorted({line for line in lines if line.startswith(("flags", "Features"))}) or [
        platform.node()
    ]
    name = hashlib.sha256("\n".join([jaxlib.__version__, *features]).encode()).hexdigest()[:16]
    folder = parent / name
    flags = os.environ.get("XLA_FLAGS", "")
    folder.mkdir(parents=True, exist_ok=True)
    if FLAG in flags:
        return folder
    decision = folder / DECISION
    if not decision.exists():
        distrusted = are_distrusted(serialize(jit(lambda x: x + 1).lower(1.0).compile()))
        write_text(decision, "AVX2" if distrusted else "all")
        if distrusted:
            print(
                f"note: XLA refuses its compiled programs here: {FLAG}=AVX2 from now on",
                file=sys.stderr,
            )
    if decision.read_text() == "AVX2":
        os.environ["XLA_FLAGS"] = f"{flags} {FLAG}=AVX2".strip()
    return folder


def are_distrusted(stored: tuple[Any, ...]) -> bool:
    """Whether XLA complains on standard error when it reads a program, given as JAX's `serialize`
    returns it."""
    if sys.__stderr__ is None:
        return False
    with tempfile.TemporaryFile() as heard:
        kept = os.dup(2)
        os.dup2(heard.fileno(), 2)
        try:
            deserialize_and_load(*stored, execution_devices=jax.local_devices()[:1])
        finally:
            os.dup2(kept, 2)
            os.close(kept)
        heard.seek(0)
        return COMPLAINT in heard.read()
