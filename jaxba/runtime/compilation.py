"""How well XLA optimises programs on a CPU: fully, or hardly and in a third to two thirds of the
time.

Compiling takes longer than most solves. A program compiled without LLVM's optimisation, and without
XLA's newer kernel emitters, whose kernels LLVM takes longest for, computes the same to rounding,
but two to six times as slowly (`python -m benchmarks.compilation`). So a single solve starts with
such programs, and compiles better ones only after as many iterations as would have paid for them
from the start: as with skis that may be rented or bought, that costs at most about twice the better
choice. Where programs are kept on disk, better ones that are there are taken from the start, and
those that are missing are compiled after the solve, by another process (runtime/background.py). The
parts of a step are programs of their own, since they gain differently, and are compiled in
parallel."""

from __future__ import annotations

import functools
import inspect
import os
import time
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, TypeVar, cast

import jax
import jax.numpy as jnp
from jax import monitoring

from jaxba.runtime.executable_cache import CachedExecutable, ExecutableCache, watch_compilation
from jaxba.runtime.fusion import fast_compilation
from jaxba.runtime.jit import Options, jit, quick_options, right_options

Function = TypeVar("Function", bound=Callable[..., Any])

# optimised; hardly; hardly at first, fully once that pays
Compilation = Literal["full", "quick", "auto"]
Level = Literal["full", "quick"]  # how much one program is optimised
# the option that switches XLA's newer kernel emitters off
OLDER_EMITTERS = "xla_cpu_use_fusion_emitters"
Kind = Literal["factorization", "iterative"]  # how a step solves its linear system
# prefix of the durations that JAX reports while it traces, lowers and compiles
COMPILE_EVENTS = "/jax/core/compile/"

BREAK_EVEN: dict[Kind, int] = {"factorization": 1_200_000, "iterative": 1_000_000}
"""Observations times iterations after which better programs have paid for their compilation, as
`benchmarks.compilation` measures it. Those of a step are compiled side by side, and so take as long
as the first."""

# iterations that a solve may well take
TYPICAL: dict[Kind, int] = {"factorization": 5, "iterative": 8}


def quick_iterations(kind: Kind, observations: int) -> int:
    """How many iterations are run before a step is compiled fully."""
    count = BREAK_EVEN[kind] // max(1, observations)
    return count if count >= TYPICAL[kind] else 0


def compiler_options(level: Level) -> Options:
    """Options of a level that this jaxlib knows; none for `full`, and on a GPU."""
    return quick_options() if level == "quick" else {}


class Program:
    """A function compiled by `jax.jit` at a level, for every shape of its arguments, which are
    given by position."""

    def __init__(self, function: Callable[..., Any], static: tuple[str, ...], level: Level) -> None:
        self.function = function
        self.options = right_options() | compiler_options(level)
        self._fast = OLDER_EMITTERS in self.options  # for these `fast_compilation` is made
        self._jitted = jax.jit(
            _strongly_typed(function),
            static_argnames=static,
            compiler_options=self.options,
            keep_unused=True,
        )
        self._static = [
            name if name in static else None for name in inspect.signature(function).parameters
        ]

    def __call__(self, *arguments: Any) -> Any:
        with fast_compilation(self._fast):
            return self._jitted(*arguments)

    def lower(self, *arguments: Any) -> tuple[Any, Any]:
        """The lowered program, not yet compiled, and shapes and types of its results."""
        with fast_compilation(self._fast):
            traced = self._jitted.trace(*arguments)
            return traced.lower(), traced.out_info

    def split(self, arguments: tuple[Any, ...]) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """Static arguments by name, and the others."""
        named = list(zip(self._static, arguments, strict=False))
        return {name: x for name, x in named if name}, tuple(x for name, x in named if not name)


def _strongly_typed(function: Callable[..., Any]) -> Callable[..., Any]:
    """The function without weakly typed results, for which a program that takes them would be
    compiled once more."""

    @functools.wraps(function)
    def strong(*arguments: Any, **named: Any) -> Any:
        results = function(*arguments, **named)
        return jax.tree.map(lambda x: jax.lax.convert_element_type(x, jnp.result_type(x)), results)

    return strong


@functools.cache
def program(function: Callable[..., Any], *static: str, level: Level = "full") -> Program:
    """The program of a function: one and the same for equal arguments. `static` names the
    function's static arguments; the level is full where XLA does not know the options of a lower
    one."""
    return Program(function, static, level)


_cache: ExecutableCache | None = None


def use_cache(folder: Path | None) -> None:
    """Makes `ParallelCompilation` keep programs of one device in a folder, which nobody else may
    write to; None: no longer. JAX's own compilation cache excludes this one: a program that JAX has
    read cannot be written again."""
    global _cache
    _cache = None if folder is None else ExecutableCache(folder)


def has_cache() -> bool:
    """Whether `ParallelCompilation` keeps programs in a folder."""
    return _cache is not None and not jax.config.values.get("jax_compilation_cache_dir")


class ParallelCompilation:
    """A context in which programs are compiled in parallel, and not run; `run` then runs them
    without compiling.

    XLA compiles one program on little more than one core. The thread that leaves the context
    compiles what is still waiting; it is the one that runs the programs, so that the memory that
    compiling took is reused for running (`process.keep_memory`). The context may be entered again
    for more programs. A program is compiled once, for the arguments that it was given first.

    Args:
        ahead: whether programs that may be wanted are compiled, too, and not only read."""

    def __init__(self, *, ahead: bool = False) -> None:
        self._ahead = ahead
        self.loaded: dict[Program, CachedExecutable] = {}  # programs that were read from disk
        self._verified: set[Program] = set()  # of these, the ones that have run once
        # called as compiled, not by `jit`: that would compile once more for results of programs
        # that were read from disk, which are bound to a device
        self._compiled: dict[Program, jax.stages.Compiled] = {}
        self._results: dict[Program, Any] = {}  # shapes and types of results
        # seconds in which `run` has compiled programs that nobody had asked for before
        self.late_s = 0.0

    def __enter__(self) -> ParallelCompilation:
        self._pool = ThreadPoolExecutor(max_workers=max(1, (os.cpu_count() or 1) - 1))
        self._waiting: deque[Callable[[], None]] = deque()
        self._jobs: list[Future[None]] = []
        return self

    def __call__(self, function: Program, *arguments: Any) -> Any:
        """Starts to compile a program for arguments that are arrays, or their shapes and types, and
        static ones. Returns shapes and types of its results, to be arguments of the next."""
        if function not in self._results:
            self._results[function] = self._begin(function, *arguments)
        return self._results[function]

    def read(self, function: Program, *arguments: Any) -> None:
        """Starts to read a program that may be wanted, if it is on disk; `ahead`, also to compile
        it."""
        path = self.path(function, *arguments)
        if self._ahead or (path and path.exists()):
            self(function, *arguments)

    def _begin(self, function: Program, *arguments: Any) -> Any:
        cache = None if jax.config.values.get("jax_compilation_cache_dir") else _cache
        path = None
        if cache is not None:
            path = self.path(function, *arguments)
            if (stored := cache.load(path)) is not None:
                self.loaded[function] = stored
                return stored.out
        lowered, out = function.lower(*arguments)

        def compile_and_store() -> None:
            with watch_compilation() as was_compiled:
                compiled = lowered.compile()
            if cache is not None:
                self._compiled[function] = compiled
                if was_compiled():
                    cache.save(path, compiled, out)

        self._waiting.append(compile_and_store)
        self._jobs.append(self._pool.submit(self._compile_next))
        return out

    def run(self, function: Program, *arguments: Any) -> Any:
        """What the program computes. It is compiled now, or read from disk, if the context has not
        had it."""
        if function not in self._results:
            started = time.perf_counter()
            with self:
                self(function, *arguments)
            self.late_s += time.perf_counter() - started
        given = function.split(arguments)[1]
        if function in self._compiled:
            return self._compiled[function](*given)
        stored = self.loaded.get(function)
        if stored is None:
            return function(*arguments)
        if function in self._verified:
            return stored.run(*given)
        try:
            result = jax.block_until_ready(stored.run(*given))
        except Exception:  # XLA finds some damage only when it runs a program
            del self.loaded[function]
            if _cache is not None:
                _cache.remove(stored)
            return function(*arguments)
        self._verified.add(function)
        return result

    def path(self, function: Program, *arguments: Any) -> Path | None:
        """The file of a program for arguments as for a call, whether it exists or not; None if it
        is not kept."""
        if _cache is None or jax.config.values.get("jax_compilation_cache_dir"):
            return None
        return _cache.path_for(function.function, *function.split(arguments), function.options)

    def _compile_next(self) -> None:
        try:
            compile_one = self._waiting.popleft()
        except IndexError:  # another thread was faster
            return
        compile_one()

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        try:
            while self._waiting and kind is None:
                self._compile_next()
        finally:
            self._waiting.clear()
            self._pool.shutdown()
        if kind is None:
            for job in self._jobs:
                job.result()


def compile_and_run(function: Program, *arguments: Any) -> Any:
    """What a program computes, for one that runs once; it is read from the cache of `use_cache` if
    it is there."""
    return (
        function(*arguments) if _cache is None else ParallelCompilation().run(function, *arguments)
    )


def traced_once(*static: str) -> Callable[[Function], Function]:
    """Decorates a function that a program contains several times: it is traced once for arguments
    of equal types.

    XLA inlines the calls, so that the program is the same; without it two fifths of the time to
    trace a step went into tracing the same functions again. `static` names its static arguments."""
    return lambda function: cast(Function, jit(function, static_argnames=static))


class CompileClock:
    """Adds up the time that JAX spends on tracing and compiling while its context is open.

    `seconds` may be read at any moment. Compilation in other threads counts too. Tracing one
    function inside another is reported by both, so the sum can slightly exceed the wall time."""

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
