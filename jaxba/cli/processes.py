"""The options of several devices and several processes, and their start."""

from __future__ import annotations

from typing import Any

from jaxba.cli import common


def start(
    coordinator: str | None, processes: int | None, process: int | None, distributed: bool, devices: int | None
) -> list[Any]:
    """Starts JAX with other processes if options ask for them; must come before any computation.

    Args:
        coordinator: of `--coordinator`, with `processes` and `process`.
        processes: of `--processes`.
        process: of `--process`.
        distributed: of `--distributed`.
        devices: of `--devices`, in each process.

    Returns:
        The devices, those of all processes; none for JAX's default one, if no option is given.

    Raises:
        UsageError: bad options, or they cannot be met.
    """
    named = [x is not None for x in (coordinator, processes, process)]
    if not (any(named) or distributed or devices is not None):
        return []
    from jaxba.runtime import distributed as runtime
    from jaxba.runtime.process import keep_memory

    if any(named) and not all(named):
        raise common.UsageError("--coordinator, --processes and --process go together")
    if any(named) and distributed:
        raise common.UsageError("--distributed finds what --coordinator, --processes and --process name: give one")
    keep_memory()  # sets how JAX starts
    try:
        if distributed or any(named):
            runtime.initialize(coordinator, processes, process)
        return runtime.use_devices(devices)
    except runtime.DistributedError as error:
        raise common.UsageError(str(error)) from None
