"""Compiled programs on disk, found without tracing them.

JAX's own compilation cache needs a program's text, which takes tracing and lowering: two thirds of
what is left of compilation where every program is cached. Here the key is what the text follows
from: the function, the types of its arguments, its static arguments, this package's source, and
JAX; `distrust.programs_folder` has a folder for each kind of processor and jaxlib. A file has one
line of JSON with the types of the results, and the executable as XLA writes and reads it; nothing
else in it is ever run. It is compressed by lzma: in a process that imports pycolmap before zlib,
zlib of Python crashes (pycolmap 4.2 brings its own)."""

from __future__ import annotations

import contextlib
import dataclasses
import functools
import hashlib
import importlib
import json
import lzma
import os
import threading
import types
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import monitoring
from jaxlib import xla_client

from jaxba.runtime import process
from jaxba.runtime.atomic import atomic_write

SUFFIX = ".jaxba-program"

# bytes that a folder's programs may have; the least recently used are removed first
LIMIT = 1 << 30
# programs read from disk that a process keeps: a solve has seven, and a mapper's adjuster many
# sizes
IN_MEMORY = 128
CACHE_SETTINGS = ("jax_compilation_cache", "jax_persistent_cache")
"""Beginnings of the names of settings of JAX's own cache."""

UNRELATED_SETTINGS = (
    *CACHE_SETTINGS,
    "jax_cpu_enable_async_dispatch",  # the commands switch it off
    "jax_enable_x64",  # of all threads; that of the thread that compiles counts
    "jax_platforms",  # the devices themselves count
    "jax_log",
    "jax_traceback",
)
"""Beginnings of the names of JAX's settings that change no program."""


class CachedExecutable(NamedTuple):
    """A compiled program and what it returns."""

    run: Callable[..., Any]  # takes the arguments that are not static
    out: Any  # shapes and types
    path: Path


class ExecutableCache:
    """Programs in a folder. Like JAX's cache it holds native code: use a folder that nobody else
    writes to."""

    def __init__(self, folder: Path) -> None:
        """For programs in a folder; that it can be written is not needed."""
        self.folder = folder
        self._source = _source()  # read now: the files may be edited while the process goes on
        # by what their keys are made of: a solve asks for ten, and describing one takes 0.7 ms
        self._paths: dict[Any, Path | None] = {}

    def path_for(
        self,
        function: Callable[..., Any],
        static: dict[str, Any],
        arguments: tuple[Any, ...],
        options: Any = None,
    ) -> Path | None:
        """The file of a program, whether it exists or not. What a function of this package computes
        follows from its arguments and the source; `static` are its static arguments by name,
        `arguments` the others in their order, pytrees of arrays or of shapes and types, and
        `options` are XLA's for this program. None where the key would not determine the program:
        where a function or class from outside this package is part of it, a user's own damping rule
        for instance."""
        leaves, tree = jax.tree.flatten(arguments)
        types = tuple(_type_of(leaf) for leaf in leaves)
        try:
            described = f"{_describe(static)}\n{_describe(options)}"
        except _UnknownSource:
            return None
        environment = _environment()
        asked = (function, described, tree, types, environment)
        if asked not in self._paths:
            self._paths[asked] = self._path_for(function, described, tree, types, environment)
        return self._paths[asked]

    def _path_for(
        self,
        function: Callable[..., Any],
        described: str,
        tree: Any,
        types: tuple[Any, ...],
        environment: str,
    ) -> Path | None:
        """The file of a program.

        Args:
            function: what it computes.
            described: its static arguments, and XLA's options.
            tree: structure of the other arguments.
            types: types of their leaves (`_type_of`).
            environment: `_environment()`."""
        try:
            key = [_name(function), described, _describe_tree(tree), *map(repr, types)]
        except _UnknownSource:
            return None
        content = "\n".join([*key, environment, self._source])
        digest = hashlib.sha256(content.encode()).hexdigest()
        return self.folder / f"{function.__name__}-{digest[:40]}{SUFFIX}"

    def load(self, path: Path | None) -> CachedExecutable | None:
        """The program of a file, which `path_for` returned; None where there is none, or none that
        can be read."""
        if path is None or not path.is_file():
            return None
        try:
            stored = _load(path)
        # of another version, damaged, or gone: it is compiled anew and overwritten
        except Exception:
            return None
        with contextlib.suppress(OSError):  # the folder may belong to another user
            os.utime(path)
        return stored

    def save(self, path: Path | None, compiled: jax.stages.Compiled, out: Any) -> None:
        """Writes a program to the path of `path_for`, whole or not at all; does nothing if it
        cannot be written.

        It must be compiled in this process (`watch_compilation`): one that JAX has read from its
        own cache is serialised without some of its functions. `out` are shapes and types of its
        results."""
        if path is None:
            return
        try:
            executable: Any = compiled.runtime_executable()
            if len(executable.get_parameter_layouts()) != len(jax.tree.leaves(compiled.args_info)):
                return  # it has constants that are not in its text
            header = json.dumps(_to_json(out)).encode()
            code = executable.client.serialize_executable(executable)
            content = lzma.compress(header + b"\n" + code, preset=0)
        except Exception:  # one that calls Python, for instance, exists in its process alone
            return
        with contextlib.suppress(OSError):
            with atomic_write(path) as file:
                file.write(content)
            files = sorted(self.folder.glob(f"*{SUFFIX}"), key=lambda file: -file.stat().st_mtime)
            total = 0
            for file in files:  # the least recently used last
                total += file.stat().st_size
                if total > LIMIT:
                    file.unlink(missing_ok=True)

    def remove(self, stored: CachedExecutable) -> None:
        """Removes a program that could be read, but not run."""
        _load.cache_clear()
        with contextlib.suppress(OSError):
            stored.path.unlink()


@contextlib.contextmanager
def watch_compilation() -> Iterator[Callable[[], bool]]:
    """Gives a function that tells whether this thread has compiled a program within the context.

    False where JAX read the program from its own cache instead."""
    thread = threading.get_ident()
    events = set()

    def listen(event: str, *_: Any, **__: Any) -> None:
        if threading.get_ident() == thread:
            events.add(event)

    hit = "/jax/compilation_cache/cache_hits"
    done = "/jax/core/compile/backend_compile_duration"
    monitoring.register_event_listener(listen)
    monitoring.register_event_duration_secs_listener(listen)
    try:
        yield lambda: done in events and hit not in events
    finally:
        monitoring.unregister_event_listener(listen)
        monitoring.unregister_event_duration_listener(listen)


# read programs, XLA each in 0.1 s, while others are looked for
_readers = ThreadPoolExecutor(max_workers=2)


@functools.lru_cache(maxsize=IN_MEMORY)
def _load(path: Path) -> CachedExecutable:
    header, _, code = lzma.decompress(path.read_bytes()).partition(b"\n")
    out = _from_json(json.loads(header))
    process.register_lapack()
    device = jax.devices()[0]
    devices = xla_client.DeviceList((device,))
    reading = _readers.submit(
        device.client.deserialize_executable, code, executable_devices=devices
    )

    def run(*arguments: Any) -> Any:
        leaves = on_device(jax.tree.leaves(arguments), device)
        results = reading.result().execute_sharded(leaves)
        arrays = [array for (array,) in results.disassemble_into_single_device_arrays()]
        return jax.tree.unflatten(jax.tree.structure(out), arrays)

    return CachedExecutable(run, out, path)


process.when_released(_load.cache_clear)


def on_device(leaves: list[Any], device: jax.Device) -> list[jax.Array]:
    """Numbers and NumPy's arrays among some arrays, all of which are on one device, come there
    together: each by itself would take 0.1 ms."""
    numbers = [leaf for leaf in leaves if not isinstance(leaf, jax.Array)]
    arrays = iter(jax.device_put(numbers, device) if numbers else [])
    return [leaf if isinstance(leaf, jax.Array) else next(arrays) for leaf in leaves]


def _to_json(out: Any) -> Any:
    """Shapes and types of arrays in tuples of this package, as JSON."""
    if out is None:
        return None
    if isinstance(out, tuple):
        return {"class": _name(type(out)), "parts": [_to_json(part) for part in out]}
    if not hasattr(out, "dtype"):
        raise _UnknownSource(repr(out))
    return [str(out.dtype), *out.shape]


def _from_json(value: Any) -> Any:
    """The reverse. Makes nothing but tuples of this package."""
    if value is None:
        return None
    if isinstance(value, list):
        return jax.ShapeDtypeStruct(tuple(value[1:]), np.dtype(value[0]))
    parts = [_from_json(part) for part in value["parts"]]
    if value["class"] == "builtins.tuple":
        return tuple(parts)
    module, _, name = value["class"].rpartition(".")
    kind = getattr(importlib.import_module(module), name) if module.startswith("jaxba.") else None
    if not (isinstance(kind, type) and issubclass(kind, tuple)):
        raise _UnknownSource(value["class"])
    return kind(*parts)


def _type_of(leaf: Any) -> tuple[Any, ...]:
    """What a program depends on of an argument, an array or a Python number."""
    if not hasattr(leaf, "dtype"):
        return (type(leaf).__name__,)
    return (np.dtype(leaf.dtype), tuple(leaf.shape), bool(getattr(leaf, "weak_type", False)))


class _UnknownSource(Exception):
    """A function or value whose description does not determine what it computes."""


def _name(thing: Any) -> str:
    """Name of a function or class whose source is known."""
    module = thing.__module__
    name = thing.__qualname__
    if module.split(".")[0] not in ("jaxba", "builtins") or "<" in name:
        raise _UnknownSource(f"{module}.{name}")
    return f"{module}.{name}"


def _describe(value: Any) -> str:
    """A text that differs for different static values."""
    if value is None or isinstance(value, (str, bool, int, float, np.dtype)):
        return repr(value)
    if isinstance(value, (tuple, list)):
        return f"({', '.join(map(_describe, value))})"
    if isinstance(value, dict):
        items = (f"{_describe(key)}: {_describe(value[key])}" for key in sorted(value))
        return f"{{{', '.join(items)}}}"
    if isinstance(known := getattr(value, "source", None), str) and known:
        # of a function from elsewhere, which has been traced
        return f"{_name(type(value))}({known})"
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        fields = ((field.name, getattr(value, field.name)) for field in dataclasses.fields(value))
        return f"{_name(type(value))}{_describe(dict(fields))}"
    if isinstance(value, functools.partial):
        return _describe((value.func, *value.args))
    if isinstance(value, types.FunctionType) and value.__module__.startswith("jaxba."):
        return _name(value)  # its source is part of the key
    raise _UnknownSource(repr(value))


def _describe_tree(tree: Any) -> str:
    """The same for the structure of a pytree."""
    node = tree.node_data()
    if node is None:
        return "*"
    kind, metadata = node
    return (
        f"{_name(kind)} {_describe(metadata)} [{', '.join(map(_describe_tree, tree.children()))}]"
    )


def _environment() -> str:
    """Everything outside a program that decides how it is compiled: JAX's settings, XLA's flags,
    the machine."""
    settings = [
        item for item in jax.config.values.items() if not item[0].startswith(UNRELATED_SETTINGS)
    ]
    x64 = jnp.result_type(float)  # whether this thread has x64 on
    flags = os.environ.get("XLA_FLAGS", "")
    return f"{sorted(settings)}\n{x64}\n{flags}\n{_machine()}"


@functools.cache
def _machine() -> str:
    devices = [
        f"{device.platform} {device.device_kind} {device.client.platform_version}"
        for device in jax.devices()
    ]
    return f"{devices}\n{jax.__version__} {os.cpu_count()}"


def _source() -> str:
    """Digest of this package's source."""
    digest = hashlib.sha256()
    folder = Path(__file__).parent.parent
    for file in sorted(folder.rglob("*.py")):
        digest.update(f"{file.relative_to(folder)}\n".encode() + file.read_bytes())
    return digest.hexdigest()
