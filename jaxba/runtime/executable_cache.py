"""Compiled programs on disk, found by what is asked of them, so that a later process does not even trace them.

JAX's own compilation cache is asked with a program's text, which takes tracing and lowering to know: two thirds of what
is left of compilation where everything is at hand (docs/performance.md). Here the question is what the text follows
from: the function, the types of its arguments, its static arguments, this package's source, JAX, and the machine.
"""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import os
import pickle
import platform
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import jaxlib
import numpy as np
from jax import monitoring
from jax.experimental import serialize_executable

ENDING = ".jaxba-program"

LIMIT = 1 << 30
"""Bytes that a folder's programs may have; what was not used for longest goes first."""

ABANDONED_S = 3600.0
"""Age of a half-written file whose writer must have been killed."""

IN_MEMORY = 16
"""Programs read from disk that a process keeps: a solve has six."""

_PRIVATE = ("jax_compilation_cache", "jax_persistent_cache")
"""Settings of JAX that change no program."""


class Stored(NamedTuple):
    """A compiled program and what it returns."""

    run: Callable[..., Any]  # takes the arguments that are not static
    out: Any  # shapes and types
    place: Path


class Store:
    """Programs in a folder. Like JAX's cache it holds native code: read it from a folder that nobody else writes to."""

    def __init__(self, folder: Path) -> None:
        """Args:
        folder: where they are; that it can be written is not needed.
        """
        self.folder = folder
        self._source = _source()  # of what runs, as nearly as can be told: it may be edited while the process goes on

    def place(
        self, function: Callable[..., Any], static: dict[str, Any], arguments: tuple[Any, ...], options: Any = None
    ) -> Path | None:
        """Where a program is kept, whether it is there or not.

        Args:
            function: of this package; what it computes follows from its arguments and the source.
            static: its static arguments, by name.
            arguments: the others, in their order: pytrees of arrays, or of shapes and types.
            options: XLA's, for this program.

        Returns:
            A path; None where it cannot be told what a program is by what is asked: where a function or a class of
            somebody else is part of it, a user's own damping rule for instance.
        """
        try:
            leaves, tree = jax.tree.flatten(arguments)
            asked = [_named(function), _text(static), _text(options), _tree_text(tree), *map(_type_text, leaves)]
        except _Unknown:
            return None
        digest = hashlib.sha256("\n".join([*asked, _circumstances(), self._source]).encode()).hexdigest()
        return self.folder / f"{function.__name__}-{digest[:40]}{ENDING}"

    def load(self, place: Path | None, arguments: tuple[Any, ...]) -> Stored | None:
        """The program of that place; None where there is none, or none that can be read.

        Args:
            place: what `place` returned.
            arguments: those that are not static, as given there.
        """
        if place is None or not place.is_file():
            return None
        try:
            stored = _load(place, jax.tree.structure((arguments, {})))
        except Exception:  # of another version, damaged, or gone: it is compiled anew and written over
            return None
        with contextlib.suppress(OSError):  # a folder of somebody else
            os.utime(place)
        return stored

    def save(self, place: Path | None, compiled: jax.stages.Compiled, out: Any) -> None:
        """Writes a program whole or not at all; what cannot be written is left.

        Args:
            place: where to.
            compiled: what was compiled in this process (`compiled_here`); of what JAX has read from its own cache, XLA
                writes a file that lacks some of its functions.
            out: shapes and types of its results.
        """
        if place is None:
            return
        try:
            code, _, _ = serialize_executable.serialize(compiled)
            shapes = jax.tree.map(lambda x: jax.ShapeDtypeStruct(x.shape, x.dtype, weak_type=x.weak_type), out)
            content = zlib.compress(pickle.dumps((shapes, code)), 1)
        except Exception:  # one that calls Python, for instance, exists in its process alone
            return
        part = place.with_name(f".{place.name}.{os.getpid()}.{threading.get_ident()}.tmp")
        with contextlib.suppress(OSError):
            try:
                part.write_bytes(content)
                part.replace(place)
            finally:
                part.unlink(missing_ok=True)
            self._tidy()

    def drop(self, stored: Stored) -> None:
        """Removes a program that could be read, but not run."""
        _load.cache_clear()
        with contextlib.suppress(OSError):
            stored.place.unlink()

    def _tidy(self) -> None:
        """Removes what was not used for longest, down to `LIMIT`, and what was never finished."""
        for part in self.folder.glob(f".*{ENDING}.*.tmp"):
            if part.stat().st_mtime < time.time() - ABANDONED_S:
                part.unlink(missing_ok=True)
        found = sorted(((file.stat(), file) for file in self.folder.glob(f"*{ENDING}")), key=lambda f: -f[0].st_mtime)
        total = 0
        for facts, file in found:
            total += facts.st_size
            if total > LIMIT:
                file.unlink(missing_ok=True)


@contextlib.contextmanager
def compiled_here() -> Iterator[Callable[[], bool]]:
    """A context that can tell whether this thread compiled a program in it, instead of reading it from JAX's cache."""
    thread, events = threading.get_ident(), set()

    def listen(event: str, *_: Any, **__: Any) -> None:
        if threading.get_ident() == thread:
            events.add(event)

    hit, done = "/jax/compilation_cache/cache_hits", "/jax/core/compile/backend_compile_duration"
    monitoring.register_event_listener(listen)
    monitoring.register_event_duration_secs_listener(listen)
    try:
        yield lambda: done in events and hit not in events
    finally:
        monitoring.unregister_event_listener(listen)
        monitoring.unregister_event_duration_listener(listen)


@functools.lru_cache(maxsize=IN_MEMORY)
def _load(place: Path, given: Any) -> Stored:
    out, code = pickle.loads(zlib.decompress(place.read_bytes()))
    _find_lapack()
    devices = jax.devices()[:1]
    run = serialize_executable.deserialize_and_load(code, given, jax.tree.structure(out), execution_devices=devices)
    return Stored(run, out, place)


@functools.cache
def _find_lapack() -> None:
    """jaxlib looks up LAPACK's routines when it first lowers a call of one; a program that calls one before crashes."""
    jax.jit(jax.lax.linalg.cholesky).lower(jax.ShapeDtypeStruct((1, 1), jnp.float32))


class _Unknown(Exception):
    """Something whose text does not say all that there is to know of it."""


def _named(thing: Any) -> str:
    """Name of a function or class whose source is known."""
    module, name = thing.__module__, thing.__qualname__
    if module.split(".")[0] not in ("jaxba", "builtins") or "<" in name:
        raise _Unknown(f"{module}.{name}")
    return f"{module}.{name}"


def _text(value: Any) -> str:
    """All there is to know of a static value."""
    if value is None or isinstance(value, (str, bool, int, float, np.dtype)):
        return repr(value)
    if isinstance(value, (tuple, list)):
        return f"({', '.join(map(_text, value))})"
    if isinstance(value, dict):
        return f"{{{', '.join(f'{_text(key)}: {_text(value[key])}' for key in sorted(value))}}}"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return f"{_named(type(value))}{_text(dict(fields))}"
    raise _Unknown(repr(value))


def _tree_text(tree: Any) -> str:
    """The same of a pytree's structure."""
    node = tree.node_data()
    if node is None:
        return "*"
    kind, facts = node
    return f"{_named(kind)} {_text(facts)} [{', '.join(map(_tree_text, tree.children()))}]"


def _type_text(leaf: Any) -> str:
    if not hasattr(leaf, "dtype"):
        return type(leaf).__name__
    return f"{leaf.dtype}{leaf.shape}{'weak' if getattr(leaf, 'weak_type', False) else ''}"


def _circumstances() -> str:
    """All else that decides what a program is."""
    settings = {name: value for name, value in jax.config.values.items() if not name.startswith(_PRIVATE)}
    settings["float"] = jnp.result_type(float)  # whether this thread has x64 on
    return f"{sorted(settings.items())}\n{os.environ.get('XLA_FLAGS', '')}\n{_machine()}"


@functools.cache
def _machine() -> str:
    facts = [jax.__version__, jaxlib.__version__, platform.machine(), str(os.cpu_count())]
    facts += [f"{device.platform} {device.device_kind} {device.client.platform_version}" for device in jax.devices()]
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.is_file() else []
    abilities = sorted({line for line in lines if line.startswith(("flags", "Features"))})
    return "\n".join([*facts, *(abilities or [platform.node()])])  # else a folder may be shared with another processor


def _source() -> str:
    """Digest of this package's source."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent.parent
    for file in sorted(folder.rglob("*.py")):
        digest.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return digest.hexdigest()
