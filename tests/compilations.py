"""Which programs JAX compiles."""

from __future__ import annotations

from jax import monitoring

PROGRAM = "/jax/core/compile/backend_compile_duration"
"""What JAX calls the compilation of a program by XLA."""


class Compilations:
    """Names of the programs that JAX compiles while it is open."""

    def __enter__(self):
        self.names = []
        monitoring.register_event_duration_secs_listener(self._listen)
        return self

    def _listen(self, event, duration, **facts):
        if event == PROGRAM:
            self.names.append(facts.get("fun_name", "").removeprefix("jit(").removesuffix(")"))

    def __exit__(self, *_):
        monitoring.unregister_event_duration_listener(self._listen)
