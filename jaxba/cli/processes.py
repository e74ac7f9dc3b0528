"""The options of several devices and several processes, and their start."""

from __future__ import annotations

from typing import Annotated, Any

from jaxba.cli import common
from jaxba.cli.options import options


@options
class Devices:
    """Devices and processes among which the work is divided."""

    devices: int | None = None
    """Devices of each process, on a CPU virtual ones: no speed-up. Default: 1; with several
    processes, all."""

    coordinator: Annotated[str | None, "HOST:PORT"] = None
    """Address of process 0, which reads, writes and prints. Start every process with the same
    options but --process."""

    processes: int | None = None
    """Number of processes."""

    process: int | None = None
    """Number of this process, from 0."""

    distributed: bool = False
    """Read --coordinator, --processes and --process from Slurm, Open MPI or Kubernetes."""


def start(args: Devices) -> list[Any]:
    """Starts JAX with other processes if asked to; must come before any computation. Returns the
    devices of all processes; none, without options, for JAX's default one. Raises InputError: bad
    options, or they cannot be met."""
    named = [x is not None for x in (args.coordinator, args.processes, args.process)]
    if not (any(named) or args.distributed or args.devices is not None):
        return []
    from jaxba.runtime import distributed
    from jaxba.runtime.process import keep_memory

    if any(named) and not all(named):
        raise common.UsageError("--coordinator, --processes and --process go together")
    if any(named) and args.distributed:
        raise common.UsageError(
            "--distributed finds what --coordinator, --processes and --process name: give one"
        )
    keep_memory()  # sets how JAX starts
    if args.distributed or any(named):
        distributed.initialize(args.coordinator, args.processes, args.process)
    return distributed.use_devices(args.devices)
