"""Checkpoints: a tree of arrays and JSON metadata in one `.npz` file, written atomically.

A tree is a flat mapping from paths to NumPy arrays; restored leaves must have the expected shape
and type."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.runtime.atomic import TEMPORARY, atomic_write
from jaxba.typing import InputError

_PREFIX = "step_"
_SUFFIX = ".npz"
_METADATA = "metadata"


class TrainError(InputError):
    """A run that cannot start or continue, or an unusable checkpoint. The message is one line for a
    person."""


def pack(tree: Any) -> dict[str, np.ndarray]:
    """Leaves of a tree by path, copied to the host; random keys as arrays."""
    leaves, _ = jax.tree_util.tree_flatten_with_path(tree)
    return {
        _name(path): np.array(jax.random.key_data(x) if _is_key(x) else x) for path, x in leaves
    }


def check(arrays: Mapping[str, Any], like: Any) -> None:
    """Compares leaves by path (`pack`) with a tree of the expected structure, of arrays or of
    `jax.ShapeDtypeStruct`. Raises TrainError: a leaf is missing, or is of another shape or type."""
    for path, leaf in jax.tree_util.tree_flatten_with_path(like)[0]:
        if (name := _name(path)) not in arrays:
            raise TrainError(f"{name} is missing")
        value = arrays[name]
        expected = jax.eval_shape(jax.random.key_data, leaf) if _is_key(leaf) else leaf
        if (value.shape, value.dtype) != (expected.shape, expected.dtype):
            found, wanted = (f"{x.dtype}{list(x.shape)}" for x in (value, expected))
            raise TrainError(f"{name} is {found}, not {wanted}")


def unpack(arrays: Mapping[str, Any], like: Any) -> Any:
    """The inverse of `pack`, in newly allocated memory; arguments and errors as for `check`."""
    check(arrays, like)

    def leaf(path: Any, expected: Any) -> Any:
        # a copy, since training donates its argument
        value = jnp.array(arrays[_name(path)], copy=True)
        return jax.random.wrap_key_data(value) if _is_key(expected) else value

    return jax.tree_util.tree_map_with_path(leaf, like)


def _name(path: Any) -> str:
    return jax.tree_util.keystr(path, simple=True, separator=".") or "all"


def _is_key(x: Any) -> bool:
    return jnp.issubdtype(x.dtype, jax.dtypes.prng_key)


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes an `.npz` file, whole or not at all. Raises OSError."""
    with atomic_write(path) as file:
        np.savez(file, **arrays)  # pyright: ignore[reportArgumentType]


def read_arrays(path: Path) -> dict[str, np.ndarray]:
    """All arrays of an `.npz` file, in its order. Raises TrainError: it is damaged. Raises OSError:
    not opened."""
    with path.open("rb") as stream:
        try:
            with np.load(stream) as file:
                return dict(file)
        # zipfile and NumPy name no set of errors for damaged files; checksums tell the rest
        except Exception:
            raise TrainError("damaged") from None


def _path(folder: Path, step: int) -> Path:
    return (folder / f"{_PREFIX}{step}{_SUFFIX}").absolute()


def steps(folder: Path) -> list[int]:
    """Numbers of the complete checkpoints in a folder, in order."""
    if not folder.is_dir():
        return []
    names = [
        item.name.removesuffix(_SUFFIX)
        for item in folder.iterdir()
        if item.name.startswith(_PREFIX)
    ]
    return sorted(
        {int(number) for name in names if (number := name.removeprefix(_PREFIX)).isdigit()}
    )


def save(
    folder: Path,
    step: int,
    arrays: Mapping[str, np.ndarray],
    metadata: Mapping[str, Any],
    keep: int,
) -> None:
    """Writes a checkpoint, over an old one of the same number, then removes all but the last `keep`
    up to it, this one included, and incomplete ones of a killed process. The folder is created if
    missing; metadata are JSON. Raises TrainError: it cannot be written; those before are still
    there. Raises OSError: the folder cannot be created."""
    folder.mkdir(parents=True, exist_ok=True)
    path = _path(folder, step)
    if path.is_dir():  # no checkpoint, and in the way of one
        shutil.rmtree(path, ignore_errors=True)
    try:
        write_arrays(
            path, {**arrays, _METADATA: np.frombuffer(json.dumps(metadata).encode(), np.uint8)}
        )
    except OSError as error:
        raise TrainError(f"{path} cannot be written: {error.strerror or error}") from None
    kept = {
        _path(folder, number).name for number in [n for n in steps(folder) if n <= step][-keep:]
    }
    for item in folder.iterdir():
        if item.name not in kept and (
            item.name.startswith(_PREFIX) or fnmatch(item.name, TEMPORARY.format("*"))
        ):
            shutil.rmtree(item, ignore_errors=True) if item.is_dir() else item.unlink(
                missing_ok=True
            )


def restore(folder: Path, step: int) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Arrays and metadata of a checkpoint. Raises TrainError: it cannot be read."""
    path = _path(folder, step)
    try:
        arrays = read_arrays(path)
        return arrays, dict(json.loads(arrays.pop(_METADATA).tobytes()))
    except (OSError, KeyError, ValueError) as error:
        reason = (isinstance(error, OSError) and error.strerror) or error
        raise TrainError(f"{path} cannot be read: {reason}") from None
