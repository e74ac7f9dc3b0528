"""Compiled programs on disk, found by what is asked of them, so that a later process does not even trace them.

JAX's own compilation cache is asked with a program's text, which takes tracing and lowering to know: two thirds of what
then is left of a start (docs/performance.md). Here the question is what the text follows from: the function, the types
of its arguments, its static arguments, the source of this package, JAX, and the machine.
"""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import platform
import threading
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlib
from jax.experimental import serialize_executable

ENDING = ".jaxba-program"

LIMIT = 1 << 30
"""Bytes that a folder may hold; what was not used for longest goes first."""

IN_MEMORY = 16
"""Programs read from disk that a process keeps: a solve has six."""

_PRIVATE = ("jax_compilation_cache", "jax_persistent_cache")
"""Settings of JAX that change no program."""


class Stored(NamedTuple):
    """A compiled program and what it returns."""

    run: Callable[..., Any]  # takes the arguments that are not static
    out: Any  # shapes and types


class Store:
    """Programs in a folder. Like JAX's cache it holds native code: read it from a folder that nobody else writes to."""

    def __init__(self, folder: Path) -> None:
        """Args:
        folder: exists and can be written.
        """
        self.folder = folder

    def place(
        self, function: Callable[..., Any], static: dict[str, Any], arguments: tuple[Any, ...], options: Any = None
    ) -> Path | None:
        """Where a program is kept, whether it is there or not.

        Args:
            function: of a module; what it computes follows from its arguments and this package's source.
            static: its static arguments, by name.
            arguments: the others, in their order: pytrees of arrays, or of shapes and types.
            options: XLA's, for this program.

        Returns:
            A path; None where something has no lasting name, such as a function among the static arguments.
        """
        leaves, tree = jax.tree.flatten(arguments)
        asked = [f"{function.__module__}.{function.__qualname__}", repr(static), repr(options), str(tree)]
        asked += [_type(leaf) for leaf in leaves]
        text = "\n".join([*asked, _circumstances()])
        if " at 0x" in text or "<locals>" in text:
            return None
        return self.folder / f"{function.__name__}-{hashlib.sha256(text.encode()).hexdigest()[:40]}{ENDING}"

    def load(self, place: Path | None, arguments: tuple[Any, ...]) -> Stored | None:
        """The program of that place; None where there is none, or none that can be used.

        Args:
            place: what `place` returned.
            arguments: those that are not static, as given there.
        """
        if place is None or not place.is_file():
            return None
        try:
            stored = _load(place, jax.tree.structure((arguments, {})))
            os.utime(place)
        except Exception:  # of another version, damaged, or gone: it is compiled anew and written over
            return None
        return stored

    def save(self, place: Path | None, compiled: jax.stages.Compiled, out: Any) -> None:
        """Writes a program whole or not at all; what cannot be written is left.

        Args:
            place: where to.
            compiled: what was compiled.
            out: shapes and types of its results.
        """
        if place is None:
            return
        try:
            code, _, _ = serialize_executable.serialize(compiled)
        except Exception:  # one with calls of Python, for instance, exists in its process alone
            return
        shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype), out)
        content = pickle.dumps((shapes, code))
        part = place.with_name(f".{place.name}.{os.getpid()}.{threading.get_ident()}.tmp")
        try:
            part.write_bytes(zlib.compress(content, 1))
            part.replace(place)
            self._tidy()
        except OSError:
            part.unlink(missing_ok=True)

    def _tidy(self) -> None:
        """Removes what was not used for longest, down to `LIMIT`."""
        found = sorted(((file.stat(), file) for file in self.folder.glob(f"*{ENDING}")), key=lambda f: -f[0].st_mtime)
        total = 0
        for facts, file in found:
            total += facts.st_size
            if total > LIMIT:
                file.unlink(missing_ok=True)


@functools.lru_cache(maxsize=IN_MEMORY)
def _load(place: Path, given: Any) -> Stored:
    out, code = pickle.loads(zlib.decompress(place.read_bytes()))
    _find_lapack()
    devices = jax.devices()[:1]
    run = serialize_executable.deserialize_and_load(code, given, jax.tree.structure(out), execution_devices=devices)
    return Stored(run, out)


@functools.cache
def _find_lapack() -> None:
    """jaxlib looks up LAPACK's routines when it first lowers a call of one; a program that calls one before crashes."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))


def _type(leaf: Any) -> str:
    if not hasattr(leaf, "dtype"):
        return type(leaf).__name__
    return f"{leaf.dtype}{leaf.shape}{'weak' if getattr(leaf, 'weak_type', False) else ''}"


def _circumstances() -> str:
    """All else that decides what a program is."""
    settings = {name: value for name, value in jax.config.values.items() if not name.startswith(_PRIVATE)}
    settings["float"] = jnp.result_type(float)  # whether this thread has x64 on
    return f"{sorted(settings.items())}\n{os.environ.get('XLA_FLAGS', '')}\n{_machine()}\n{_source()}"


@functools.cache
def _machine() -> str:
    facts = [jax.__version__, jaxlib.__version__, platform.machine(), str(os.cpu_count())]
    facts += [f"{device.platform} {device.device_kind} {device.client.platform_version}" for device in jax.devices()]
    cpus = Path("/proc/cpuinfo")
    if cpus.is_file():
        facts += sorted({line for line in cpus.read_text().splitlines() if line.startswith("flags")})
    return "\n".join(facts)


@functools.cache
def _source() -> str:
    """Digest of this package's source."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent
    for file in sorted(folder.rglob("*.py")):
        digest.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return digest.hexdigest()
