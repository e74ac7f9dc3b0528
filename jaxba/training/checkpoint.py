"""Checkpoints: a tree of arrays and JSON metadata, written atomically.

Orbax writes into a temporary folder and renames it, so that a checkpoint with its final name is complete. A tree is
stored as a flat mapping from paths to NumPy arrays; every leaf that is restored must have the expected shape and type.
"""

from __future__ import annotations

import errno
import gc
import json
import logging
import os
import shutil
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.runtime import distributed

_PREFIX = "step_"
_METADATA = "metadata"


class CheckpointError(ValueError):
    """A checkpoint that cannot be used. The message is one line for a person."""


def pack(tree: Any) -> dict[str, np.ndarray]:
    """Leaves of a tree by path, copied to the host from all devices; random keys as arrays."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    whole = lambda x: np.array(distributed.to_host(x) if isinstance(x, jax.Array) else x)
    return {_name(path): whole(jax.random.key_data(x) if _is_key(x) else x) for path, x in leaves}


def check(arrays: Mapping[str, Any], like: Any) -> None:
    """Compares leaves by path with a tree.

    Args:
        arrays: see `pack`.
        like: a tree of the expected structure, of arrays or of `jax.ShapeDtypeStruct`.

    Raises:
        CheckpointError: a leaf is missing, or is of another shape or type.
    """
    for path, leaf in jax.tree_util.tree_flatten_with_path(like)[0]:
        if (name := _name(path)) not in arrays:
            raise CheckpointError(f"{name} is missing")
        value, expected = arrays[name], jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        if (value.shape, value.dtype) != (expected.shape, expected.dtype):
            found, wanted = (f"{x.dtype}{list(x.shape)}" for x in (value, expected))
            raise CheckpointError(f"{name} is {found}, not {wanted}")


def unpack(arrays: Mapping[str, Any], like: Any) -> Any:
    """The inverse of `pack`, in newly allocated memory.

    Args:
        arrays: leaves by path.
        like: see `check`; a `jax.ShapeDtypeStruct` with a sharding says on which devices a leaf lies.

    Raises:
        CheckpointError: see `check`.
    """
    check(arrays, like)

    def leaf(path: Any, expected: Any) -> Any:
        value, sharding = arrays[_name(path)], getattr(expected, "sharding", None)
        new = lambda part: jnp.array(part, copy=True)  # a copy, since training donates its argument
        if sharding is None or isinstance(expected, jax.Array):
            value = new(value)
        else:
            value = jax.make_array_from_callback(value.shape, sharding, lambda rows: new(value[rows]))
        return jax.random.wrap_key_data(value) if _is_key(expected) else value

    return jax.tree_util.tree_map_with_path(leaf, like)


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".") or "all"


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def steps(folder: Path) -> list[int]:
    """Numbers of the complete checkpoints in a folder, in order."""
    if not folder.is_dir():
        return []
    names = [item.name.removeprefix(_PREFIX) for item in folder.iterdir() if item.name.startswith(_PREFIX)]
    return sorted(int(name) for name in names if name.isdigit())


def save(folder: Path, step: int, arrays: Mapping[str, np.ndarray], metadata: Mapping[str, Any], keep: int) -> None:
    """Writes a checkpoint, then removes all but the last `keep` up to it, and incomplete ones of a killed process.

    Args:
        folder: of all checkpoints; created if missing.
        step: number of this checkpoint; an old one of the same number is replaced.
        arrays: see `pack`.
        metadata: anything that JSON can hold.
        keep: number of checkpoints kept, this one included.

    Raises:
        CheckpointError: it cannot be written; those before are still there.
        OSError: the folder cannot be created.
    """
    import orbax.checkpoint as ocp

    folder.mkdir(parents=True, exist_ok=True)
    content = {**arrays, _METADATA: np.frombuffer(json.dumps(metadata).encode(), np.uint8)}
    path = (folder / f"{_PREFIX}{step}").absolute()
    reason = ""
    with _quiet_tasks():
        try:
            with ocp.StandardCheckpointer(**_alone()) as checkpointer:
                checkpointer.save(path, content, force=True)
                checkpointer.wait_until_finished()
        except Exception as error:  # of a full disk Orbax makes a ValueError with a page of text
            full = os.strerror(errno.ENOSPC)
            reason = full if full in str(error) else _reason(error)
        if reason:
            gc.collect()  # asyncio reports errors of tasks when these are collected
    if reason:
        sys.excepthook = _without_closed_loops(sys.excepthook)  # callbacks of the same failure still come in
        raise CheckpointError(f"{path} cannot be written: {reason}")
    complete = {f"{_PREFIX}{number}" for number in [n for n in steps(folder) if n <= step][-keep:]}
    for item in folder.iterdir():
        if item.name.startswith(_PREFIX) and item.name not in complete:
            shutil.rmtree(item, ignore_errors=True)


def _alone() -> dict[str, Any]:
    """Options by which Orbax does not wait for other processes, of which none calls it."""
    import orbax.checkpoint as ocp

    if jax.process_count() == 1:
        return {}
    one = ocp.options.MultiprocessingOptions(
        primary_host=jax.process_index(), active_processes={jax.process_index()}, barrier_sync_key_prefix="jaxba"
    )
    return {"multiprocessing_options": one}


@contextmanager
def _quiet_tasks() -> Iterator[None]:
    """In which errors of Orbax's tasks and threads are not reported with a page of text each: the first is raised."""
    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    before, hook = [logger.disabled for logger in loggers], sys.excepthook
    try:
        for logger in loggers:
            logger.disabled = True
        sys.excepthook = lambda *_: None  # of callbacks from C++
        yield
    finally:
        sys.excepthook = hook
        for logger, disabled in zip(loggers, before, strict=True):
            logger.disabled = disabled


def _without_closed_loops(hook: Callable[..., Any]) -> Callable[..., Any]:
    """The hook for all errors but those of callbacks that come when their event loop is gone."""

    def report(kind: type[BaseException], error: BaseException, traceback: Any) -> None:
        if not (kind is RuntimeError and str(error) == "Event loop is closed"):
            hook(kind, error, traceback)

    return report


def restore(folder: Path, step: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and metadata of a checkpoint.

    Raises:
        CheckpointError: it cannot be read.
    """
    import orbax.checkpoint as ocp

    path = (folder / f"{_PREFIX}{step}").absolute()
    try:
        with ocp.Checkpointer(ocp.PyTreeCheckpointHandler(**_alone()), **_alone()) as checkpointer:
            content = checkpointer.restore(path)
        arrays = {name: np.asarray(value) for name, value in content.items()}
        return arrays, dict(json.loads(arrays.pop(_METADATA).tobytes()))
    except Exception as error:  # Orbax names no set of errors for damaged files
        raise CheckpointError(f"{path} cannot be read: {_reason(error)}") from None


def _reason(error: Exception) -> str:
    """The first line of an error."""
    return next(iter(str(error).splitlines()), "") or type(error).__name__
