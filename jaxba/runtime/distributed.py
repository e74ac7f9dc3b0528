"""Several processes and several devices: JAX's own runtime, which has to be started before anything
is computed.

All processes run the same program on the same arguments. Where only the first may act, since it
reads or writes files, `together` hands what it found to the others."""

from __future__ import annotations

import contextlib
import itertools
import os
import pickle
import socket
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

import jax
import numpy as np
from jax._src import distributed as runtime  # its key-value store has no public name
from jax.experimental import multihost_utils

from jaxba.typing import InputError

T = TypeVar("T")

START_S = 300  # seconds that processes wait for each other at the start. JAX's default
PATIENCE_S = 5  # seconds after which a process says that it waits for others at the start
# seconds of silence after which a process counts as dead and JAX ends the others; its default is
# 100
HEARTBEAT_S = 30
# twelve days, for which processes wait for the first one; Gloo's collectives wait half an hour
WAIT_MS = 1 << 30
# of XLA for each virtual device. With one for each, two and four devices on two cores came to a
# standstill
THREADS = 8
BLOCK = 1 << 24  # bytes that are sent to other processes at once
# in errors where a process is gone
LOST_WORDS = ("Gloo", "NCCL", "coordination service", "CoordinationService")

_done = itertools.count()


class MainFailedError(Exception):
    """The first process has failed, and says why itself."""


def initialize(
    coordinator: str | None = None, processes: int | None = None, process: int | None = None
) -> None:
    """Connects this process with the others, before any computation with JAX. On CPUs they talk by
    gloo.

    Where not all have started after `START_S` the process ends with one line. The coordinator is
    `HOST:PORT` of the first process, on a port that is free there; processes have numbers from 0.
    Without all three JAX finds them under Slurm, Open MPI and Kubernetes. Raises InputError: bad
    arguments, none were found, or the first process cannot use its port. Raises RuntimeError: JAX
    has computed already."""
    given = [x is not None for x in (coordinator, processes, process)]
    if any(given) and not all(given):
        raise InputError(
            "coordinator, number of processes and number of this process must be given together"
        )
    if coordinator is not None and processes is not None and process is not None:
        _check(coordinator, processes, process)
    # it would catch SIGTERM, and the process live on
    jax.config.update("jax_enable_preemption_service", False)
    try:
        with _deadline(START_S):
            jax.distributed.initialize(
                coordinator,
                processes,
                process,
                # at whose end it would abort the process with a stack trace
                initialization_timeout=2 * START_S,
                heartbeat_timeout_seconds=HEARTBEAT_S,
            )
    except ValueError as error:
        raise InputError(f"no coordinator was given, and JAX found none: {error}") from None


@contextlib.contextmanager
def _deadline(seconds: float) -> Iterator[None]:
    """In which processes wait for each other: says so after a while, and ends this one at the
    deadline."""

    def give_up() -> None:
        print(
            f"error: not all processes of this run have started in {seconds:g} s",
            file=sys.stderr,
            flush=True,
        )
        os._exit(2)

    def say():
        return print("note: waiting for the other processes", file=sys.stderr, flush=True)

    timers = threading.Timer(PATIENCE_S, say), threading.Timer(seconds, give_up)
    for timer in timers:
        timer.daemon = True
        timer.start()
    try:
        yield
    finally:
        for timer in timers:
            timer.cancel()


def _check(coordinator: str, processes: int, process: int) -> None:
    """Refuses what would end the process inside JAX's runtime with a page of text."""
    if not 0 <= process < processes:
        raise InputError(f"process {process} is none of 0 to {processes - 1}")
    host, _, number = coordinator.rpartition(":")
    if not host or not number.isdecimal() or not 0 < int(number) < 2**16:
        raise InputError(f"coordinator must be HOST:PORT, not {coordinator!r}")
    if process == 0:
        with socket.socket() as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind(("", int(number)))
            except OSError as error:
                raise InputError(f"coordinator {coordinator}: {error.strerror or error}") from None


def is_main() -> bool:
    """Whether this is the first process, which alone prints and writes. Starts JAX: `use_devices`
    comes before."""
    return not jax.distributed.is_initialized() or jax.process_index() == 0


def has_lost_process(error: BaseException) -> bool:
    """Whether an error was raised because another process of this run is gone."""
    return jax.distributed.is_initialized() and any(word in str(error) for word in LOST_WORDS)


def use_devices(count: int | None) -> list[jax.Device]:
    """The first devices of every process, in the order of the processes.

    A CPU is one device; where nothing was computed yet it becomes as many virtual ones as are asked
    for. `count` is that of each process; None: one, or all with several processes. Raises
    InputError: a process has fewer."""
    if count is not None:
        count = int(count)
        if count < 1:
            raise InputError(f"at least one device is needed, not {count}")
        if count > 1:
            with contextlib.suppress(RuntimeError):  # JAX has started
                jax.config.update("jax_num_cpu_devices", count)
    with _threads(THREADS * (count or 1)):
        if count is None and jax.process_count() == 1:
            count = 1
        found = jax.local_devices()
    if count is not None and len(found) < count:
        kind = found[0].platform.upper()
        raise InputError(f"{count} devices asked for, {len(found)} of kind {kind} found")

    def own(process):
        return [x for x in jax.devices() if x.process_index == process][:count]

    return [device for process in range(jax.process_count()) for device in own(process)]


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    """In which JAX starts with so many of XLA's threads for virtual devices, unless it has started
    or NPROC is set.

    Devices share them: with few, batched factorisations of several wait for each other for ever."""
    if count <= THREADS or "NPROC" in os.environ:
        yield
        return
    os.environ["NPROC"] = str(count)
    try:
        yield
    finally:
        del os.environ["NPROC"]


def together(work: Callable[[], T]) -> T:
    """Runs a function in the first process and returns its result in every process; the others
    wait. Raises MainFailedError: in the other processes, if it raised an error; the first process
    raises that error itself."""
    if not jax.distributed.is_initialized() or jax.process_count() == 1:
        return work()
    client: Any = runtime.global_state.client
    name = f"jaxba/{next(_done)}"
    if not is_main():
        client.blocking_key_value_get(name, WAIT_MS)
        found, buffers = _broadcast(b"", [])
        if not found:
            raise MainFailedError
        return pickle.loads(found, buffers=buffers)
    content = b""
    buffers = []
    try:
        result = work()
        arrays: list[pickle.PickleBuffer] = []  # of NumPy, which are sent as they are
        content = pickle.dumps(result, protocol=5, buffer_callback=arrays.append)
        buffers = [one.raw() for one in arrays]
    finally:
        client.key_value_set(name, "done")
        _broadcast(content, buffers)
    return result


def _broadcast(content: bytes, buffers: Sequence[Any]) -> tuple[bytes, Sequence[Any]]:
    """The content and the buffers that the first process has, in all of them."""
    send = multihost_utils.broadcast_one_to_all
    each = [content, pickle.dumps([len(one) for one in buffers])]
    counts = np.asarray(send(np.asarray([len(one) for one in each], np.int32)))
    each = each if is_main() else [bytearray(int(count)) for count in counts]
    _send(each)
    sizes = pickle.loads(each[1])
    buffers = buffers if is_main() else [bytearray(size) for size in sizes]
    _send(buffers)
    return bytes(each[0]), buffers


def _send(buffers: Sequence[Any]) -> None:
    """Fills the buffers of all other processes with those of the first one, block by block: JAX
    copies what it sends several times."""
    for buffer in buffers:
        whole = np.frombuffer(buffer, np.uint8)
        for start in range(0, len(whole), BLOCK):
            block = whole[start : start + BLOCK]
            found = multihost_utils.broadcast_one_to_all(block)
            if not is_main():
                block[:] = np.asarray(found)


def gather(values: list[T]) -> list[T]:
    """The values of all processes, in the order of the processes."""
    if jax.process_count() == 1:
        return values
    content = np.frombuffer(pickle.dumps(values), np.uint8)
    sizes = np.asarray(multihost_utils.process_allgather(np.asarray(len(content), np.int32)))
    padded = np.zeros(int(sizes.max()), np.uint8)
    padded[: len(content)] = content
    parts = np.asarray(multihost_utils.process_allgather(padded)).reshape(len(sizes), -1)
    return [
        one
        for part, size in zip(parts, sizes, strict=True)
        for one in pickle.loads(part[:size].tobytes())
    ]


def to_host(x: Any) -> np.ndarray:
    """The whole of an array that lies on devices of several processes, in each of them."""
    if isinstance(x, np.ndarray) or x.is_fully_addressable or x.is_fully_replicated:
        return np.asarray(x)
    return np.asarray(multihost_utils.process_allgather(x, tiled=True))
