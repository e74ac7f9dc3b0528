"""How XLA compiles programs on a CPU: with all optimisation, or in a third to half of the time.

Compiling takes longer than most solves. A program made without LLVM's optimisation, and without XLA's newer kernel
emitters, whose kernels LLVM takes longest for, computes the same to rounding, but two to six times as slowly; with
LLVM's first level alone, in half of the time, it is nearly as fast as with all (`python -m benchmarks.compilation`,
docs/performance.md). So who has one problem to solve starts with one of these, and pays for a better program only where
so many iterations come that it would have been cheaper from the start: as with skis that may be rented or bought, that
is never much dearer than the better of the two. The parts of a step are programs of their own, since they gain
differently, and are compiled beside each other.
"""

from __future__ import annotations

import functools
import inspect
import os
from collections import deque
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar, cast, get_args

import jax

from jaxba.runtime.executable_cache import Store, Stored, compiled_here
from jaxba.runtime.single_loop import in_haste

Function = TypeVar("Function", bound=Callable[..., Any])

Compilation = Literal["full", "quick", "auto"]
"""`full`: all optimisation. `quick`: hardly any. `auto`: by the number of observations hardly any or little, and all
after as many iterations as pay for it."""

COMPILATIONS: tuple[str, ...] = get_args(Compilation)

Way = Literal["full", "brisk", "quick"]
"""How one program is compiled."""

HASTE: dict[Way, dict[str, bool | int]] = {
    "brisk": {"xla_backend_optimization_level": 1, "xla_cpu_use_fusion_emitters": False},
    "quick": {"xla_backend_optimization_level": 0, "xla_cpu_use_fusion_emitters": False},
}
"""XLA's options. Without the older emitters a level alone saves half as much."""

Part = Literal["factored", "iterated", "try_step", "round"]
"""What is compiled by itself: a linear solve by factorisation or by an iteration, the verdict on its step, or a round
of domain decomposition."""


class Stage(NamedTuple):
    """A way of compiling, and how often a program is run so before the next better one is made."""

    way: Way
    runs: int


class Pays(NamedTuple):
    """When a better program pays for its compilation (`python -m benchmarks.compilation`, docs/performance.md)."""

    typical: int
    """Runs, counted as `REPAIR` says, that a solve may well take: a program that would not last so long is left out. Of
    the fifteen real problems nine converge in 3 to 9 iterations with 0 to 2 repairs, the others take 15 to 98 with one
    to three repairs each. Chosen with whole calls of eight problems in sight (docs/performance.md)."""

    quick: int
    """Observations times runs of a quick program after which the brisk one has paid for its compilation."""

    brisk: int
    """The same of a brisk program, after which the optimised one has."""


PAYS: dict[Part, Pays] = {
    "factored": Pays(typical=5, quick=220_000, brisk=4_000_000),
    "iterated": Pays(typical=8, quick=1_000_000, brisk=15_000_000),
    "try_step": Pays(typical=80, quick=7_000_000, brisk=30_000_000),
    "round": Pays(typical=8, quick=1_600_000, brisk=8_000_000),
}

REPAIR = 2
"""How often a verdict counts for each camera round or further trial that it takes: a quick one takes 0.6 us longer
for an observation, the verdict without any 0.1 to 0.5 (on the two sequences of KITTI)."""


def stages(part: Part, observations: int) -> tuple[Stage, ...]:
    """How a part of a step for so many observations is compiled, one way after the other, before the optimised one."""
    typical, *repaid = PAYS[part]
    ways: tuple[Way, ...] = ("quick", "brisk")
    found = [Stage(way, count // max(1, observations)) for way, count in zip(ways, repaid, strict=True)]
    return tuple(stage for stage in found if stage.runs >= typical)


def way_after(runs: int, before: tuple[Stage, ...]) -> Way:
    """How a program is compiled that was run so often; after its stages it is optimised."""
    for way, count in before:
        if runs < count:
            return way
        runs -= count
    return "full"


@functools.cache
def options_of(way: Way) -> dict[str, bool | int] | None:
    """XLA's options; None where there is no such way, on a GPU or in another jaxlib, and for `full`."""
    if way not in HASTE or jax.default_backend() != "cpu":
        return None
    options = dict(HASTE[way])
    try:
        jax.jit(lambda: 0, compiler_options=options).lower().compile()
    except jax.errors.JaxRuntimeError:  # an option that it does not know
        return None
    return options


class Program:
    """A function compiled by `jax.jit` for every shape of its arguments, which are given by position."""

    def __init__(self, function: Callable[..., Any], static: tuple[str, ...], way: Way) -> None:
        self.function = function
        self.options: Any = options_of(way)
        self.jitted = jax.jit(function, static_argnames=static, compiler_options=self.options)
        self._static = [name if name in static else None for name in inspect.signature(function).parameters]

    def __call__(self, *arguments: Any) -> Any:
        with in_haste(self.options is not None):
            return self.jitted(*arguments)

    def lower(self, *arguments: Any) -> tuple[Any, Any]:
        """What is compiled, and shapes and types of its results."""
        with in_haste(self.options is not None):
            traced = self.jitted.trace(*arguments)
            return traced.lower(), traced.out_info

    def parted(self, arguments: tuple[Any, ...]) -> tuple[dict[str, Any], tuple[Any, ...]]:
        """Static arguments by name, and the others."""
        named = list(zip(self._static, arguments, strict=False))
        return {name: x for name, x in named if name}, tuple(x for name, x in named if not name)


@functools.cache
def program(function: Callable[..., Any], *static: str, way: Way = "full") -> Program:
    """The function compiled, one program for each way of compiling.

    Args:
        function: what it computes.
        static: names of its static arguments.
        way: optimised or hardly, if that can be had.
    """
    return Program(function, static, way)


_store: Store | None = None


def keep_in(folder: Path | None) -> None:
    """Has `CompiledTogether` look for programs in a folder, and leave them there for later processes.

    For solves with a callback or compiled quickly (`solve(compilation="auto")`): the loop as one program has JAX's own
    compilation cache. Where that is switched on it is the only one.

    Args:
        folder: exists and can be written, by nobody else; None keeps nothing.
    """
    global _store
    _store = None if folder is None else Store(folder)


class CompiledTogether:
    """A context in which programs are compiled beside each other, and not run; `run` compiles nothing then.

    XLA compiles one program on little more than one core. Who leaves the context compiles what is still waiting, in the
    thread that will run it: the memory that this takes is then there for running (`host.keep_memory`). It may be
    entered again for more; a program is compiled once, for the arguments that it was given first.
    """

    def __init__(self) -> None:
        self.loaded: dict[Program, Stored] = {}
        """What was on disk."""
        self._proven: set[Program] = set()
        self._known: dict[Program, Any] = {}  # shapes and types of results

    def __enter__(self) -> CompiledTogether:
        self._pool = ThreadPoolExecutor(max_workers=max(1, (os.cpu_count() or 1) - 1))
        self._waiting: deque[Callable[[], None]] = deque()
        self._jobs: list[Future[None]] = []
        return self

    def __call__(self, function: Program, *arguments: Any) -> Any:
        """Has a program compiled for such arguments.

        Args:
            function: what `program` returned.
            arguments: arrays, or their shapes and types, and static arguments.

        Returns:
            Shapes and types of its results, to be arguments of the next.
        """
        if function not in self._known:
            self._known[function] = self._begin(function, *arguments)
        return self._known[function]

    def _begin(self, function: Program, *arguments: Any) -> Any:
        store, place = None if jax.config.values.get("jax_compilation_cache_dir") else _store, None
        if store is not None:
            static, given = function.parted(arguments)
            place = store.place(function.function, static, given, function.options)
            if (stored := store.load(place, given)) is not None:
                self.loaded[function] = stored
                return stored.out
        lowered, out = function.lower(*arguments)

        def compile_and_keep() -> None:
            if store is None:
                lowered.compile()
                return
            with compiled_here() as is_new:
                compiled = lowered.compile()
            if is_new():
                store.save(place, compiled, out)

        self._waiting.append(compile_and_keep)
        self._jobs.append(self._pool.submit(self._compile_next))
        return out

    def run(self, function: Program, *arguments: Any) -> Any:
        """What the program computes."""
        stored = self.loaded.get(function)
        if stored is None:
            return function(*arguments)
        given = function.parted(arguments)[1]
        if function in self._proven:
            return stored.run(*given)
        try:
            result = jax.block_until_ready(stored.run(*given))
        except Exception:  # XLA finds some damage only when it runs a program
            del self.loaded[function]
            if _store is not None:
                _store.drop(stored)
            return function(*arguments)
        self._proven.add(function)
        return result

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


def run_alone(function: Program, *arguments: Any) -> Any:
    """What a program computes, for one that is needed once; as `CompiledTogether` it looks for it on disk."""
    with CompiledTogether() as together:
        together(function, *arguments)
    return together.run(function, *arguments)


def traced_once(*static: str) -> Callable[[Function], Function]:
    """Decorates what a program contains several times: traced once for arguments of equal types, and called.

    XLA inlines the calls, so that the program is the same; two fifths of the time to trace a step went into copies.

    Args:
        static: names of its static arguments.
    """
    return lambda function: cast(Function, jax.jit(function, static_argnames=static))
