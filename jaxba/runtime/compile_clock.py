"""How long JAX spent tracing and compiling."""

from __future__ import annotations

from typing import Any

from jax import monitoring

COMPILE_EVENTS = "/jax/core/compile/"
"""Prefix of the durations that JAX reports while it traces, lowers and compiles."""


class CompileClock:
    """Adds up compilation time while its context is open; `seconds` may be read at any moment.

    Compilation of other threads counts too. Tracing one function inside another is reported by both, so the
    sum can exceed the wall time by that little.
    """

    def __init__(self) -> None:
        self.seconds = 0.0

    def _listen(self, event: str, duration_secs: float, **_: Any) -> None:
        if event.startswith(COMPILE_EVENTS):
            self.seconds += duration_secs

    def __enter__(self) -> CompileClock:
        monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def __exit__(self, *_: object) -> None:
        monitoring.unregister_event_duration_listener(self._listen)
