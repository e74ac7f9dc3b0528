"""Policy files: a trained agent in one `.safetensors` file.

It holds the actor's weights; its metadata are the agent's configuration and the policy's origin."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import observation_size
from jaxba.damping.learned import Layer, LearnedPolicy
from jaxba.runtime.atomic import atomic_write
from jaxba.settings import read
from jaxba.typing import InputError

FORMAT = "jaxba-policy-1"  # kind and version of a policy file, in its metadata
LARGEST_FILE = 1 << 20  # largest size of a policy file in bytes


def save_policy(
    path: str | Path, policy: LearnedPolicy, metadata: dict[str, str] | None = None
) -> None:
    """Writes a policy file atomically; solver names accept it if it ends in `.safetensors`.
    `metadata` says where the policy comes from, for people. Raises InputError: the file would be
    larger than `LARGEST_FILE`."""
    from safetensors.numpy import save

    tensors = {}
    for k, layer in enumerate(policy.layers):
        tensors[f"layer{k}.kernel"] = np.asarray(layer.kernel, np.float32)
        tensors[f"layer{k}.bias"] = np.asarray(layer.bias, np.float32)
    metadata = {**(metadata or {}), "format": FORMAT, "agent": json.dumps(asdict(policy.config))}
    content = _with_sorted_metadata(save(tensors, metadata))
    if len(content) > LARGEST_FILE:
        raise InputError(
            f"{path}: a policy of {len(content)} bytes, more than the {LARGEST_FILE} of a policy "
            "file"
        )
    with atomic_write(path) as file:
        file.write(content)


def _with_sorted_metadata(content: bytes) -> bytes:
    """The same file with its metadata sorted, so that equal policies are equal files: safetensors'
    order is random."""
    size = int.from_bytes(content[:8], "little")
    header = json.loads(content[8 : 8 + size])
    header["__metadata__"] = dict(sorted(header["__metadata__"].items()))
    text = json.dumps(header, separators=(",", ":"), ensure_ascii=False).encode()
    text += b" " * (-len(text) % 8)  # tensors begin at a multiple of eight bytes
    return len(text).to_bytes(8, "little") + text + content[8 + size :]


def load_policy(path: str | Path) -> LearnedPolicy:
    """Reads a policy file. Raises InputError: unreadable, no policy, or weights of another
    configuration."""
    tensors, metadata = _read(Path(path))
    if metadata.get("format") != FORMAT:
        raise InputError(
            f"{path}: no policy of jaxba (its metadata says {metadata.get('format', 'nothing')!r})"
        )
    try:
        config = read(AgentConfig, json.loads(metadata["agent"]))
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: cannot be used by this version: {error}") from None
    count = len(tensors) // 2
    try:
        layers = tuple(
            Layer(tensors[f"layer{k}.kernel"], tensors[f"layer{k}.bias"]) for k in range(count)
        )
    except KeyError as error:
        raise InputError(f"{path}: {error} is missing") from None
    size = observation_size(config)
    for k, layer in enumerate(layers):
        if (
            layer.kernel.ndim != 2
            or layer.kernel.shape[0] != size
            or layer.bias.shape != layer.kernel.shape[1:]
        ):
            raise InputError(
                f"{path}: layer {k} has the shape {layer.kernel.shape}, which does not take {size} "
                "numbers "
                f"(observation {config.observation!r}, history {config.history})"
            )
        if layer.kernel.dtype != np.float32 or layer.bias.dtype != np.float32:
            raise InputError(f"{path}: layer {k} is not of type float32")
        if not (np.isfinite(layer.kernel).all() and np.isfinite(layer.bias).all()):
            raise InputError(f"{path}: layer {k} holds numbers that are not finite")
        size = layer.kernel.shape[1]
    if not layers or size != 2:
        raise InputError(f"{path}: the last layer must give 2 numbers, not {size}")
    return LearnedPolicy(tuple(layers), config)


def _read(path: Path) -> tuple[dict[str, np.ndarray], dict[str, str]]:
    from safetensors import SafetensorError, safe_open

    try:
        if path.is_dir():
            raise InputError(f"{path}: a directory, not a policy file")
        if path.stat().st_size > LARGEST_FILE:
            raise InputError(f"{path}: no policy file, it is larger than {LARGEST_FILE} bytes")
        with safe_open(path, framework="numpy") as file:
            tensors = {name: file.get_tensor(name) for name in file.keys()}  # noqa: SIM118 - not a mapping
            return tensors, dict(file.metadata() or {})
    except OSError as error:
        raise InputError(f"{path}: {error.strerror or 'no such file'}") from None
    except SafetensorError:
        raise InputError(f"{path}: not a safetensors file") from None
