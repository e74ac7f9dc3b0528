"""What there is to carry (lines, statements, classes, rooms, branches, words), how plain it is, and
how far a value walks through the code.

    python -m benchmarks.size [FOLDER]

FOLDER holds the checkout to measure, the current one by default. Walks are those of the package
that Python imports."""

from __future__ import annotations

import ast
import re
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from graphlib import TopologicalSorter
from itertools import pairwise
from pathlib import Path
from types import FrameType
from typing import Any

import jax
import jax.numpy as jnp

import jaxba
from benchmarks.plainness import plainness

LABORATORY = ("methods", "kitti", "datasets/kitti", "game", "training", "peers", "bench", "paper")
"""Rooms that ask rather than solve, as in tests/test_imports.py; earlier versions had KITTI among
the data sets."""

LABORATORY_COMMANDS = ("bench", "train", "kitti", "paper")
"""Modules of commands that belong to them."""

CORE = ("model", "linear", "refinement", "lm", "structure", "solver", "results")
"""Rooms whose branches on None are counted."""


def sources(root: Path) -> dict[str, str]:
    """Source text of each file of the package, pages included, by its path below the package."""
    files = [path for path in (root / "jaxba").rglob("*") if path.suffix in (".py", ".js", ".css")]
    return {str(path.relative_to(root / "jaxba")): path.read_text() for path in sorted(files)}


def in_laboratory(path: str) -> bool:
    """Whether a file belongs to the laboratory."""
    commands = {f"cli/{name}" for name in LABORATORY_COMMANDS}
    return (
        path.startswith(tuple(f"{room}/" for room in LABORATORY))
        or path.removesuffix(".py") in commands
    )


def room(path: str) -> str:
    """Room of a file: its top folder, or its own name."""
    return path.partition("/")[0].removesuffix(".py")


def arrows(texts: dict[str, str]) -> dict[str, set[str]]:
    """Rooms that each room imports."""
    rooms = {room(path) for path in texts}
    found: dict[str, set[str]] = {name: set() for name in rooms}
    for path, text in texts.items():
        for module in re.findall(r"^\s*(?:from|import) jaxba\.(\w+)", text, re.MULTILINE):
            if module in rooms - {room(path)}:
                found[room(path)].add(module)
    return found


def floors(graph: dict[str, set[str]]) -> int:
    """Longest chain of rooms in which each imports the next."""
    depth: dict[str, int] = {}
    for name in TopologicalSorter(graph).static_order():
        depth[name] = 1 + max((depth[below] for below in graph[name]), default=0)
    return max(depth.values())


def inner_imports(root: Path) -> int:
    """Names that tests import and that neither `jaxba` offers nor a page of the documents
    describes."""
    described = {
        name
        for path in (root / "docs").rglob("*.md")
        for name in re.findall(r"^::: (\S+)", path.read_text(), re.M)
    }
    public = described | {f"jaxba.{name}" for name in jaxba.__all__}
    found = 0
    for path in (root / "tests").rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.ImportFrom)
                and (node.module or "").partition(".")[0] == "jaxba"
            ):
                names = [name.name for name in node.names]
                found += sum(
                    not public & {f"{node.module}.{name}", f"jaxba.{name}"} for name in names
                )
    return found


def counts(root: Path) -> dict[str, float]:
    """The table of what there is."""
    texts = sources(root)
    python = {path: text for path, text in texts.items() if path.endswith(".py")}
    lines = {path: text.count("\n") for path, text in texts.items()}
    graph = arrows(python)
    documents = [root / "README.md", *(root / "docs").rglob("*.md")]
    return {
        "lines": sum(lines.values()),
        "lines of the library": sum(
            count for path, count in lines.items() if not in_laboratory(path)
        ),
        "lines of the laboratory": sum(
            count for path, count in lines.items() if in_laboratory(path)
        ),
        "files": len(texts),
        "classes": sum(
            len(re.findall(r"^\s*class \w", text, re.MULTILINE)) for text in python.values()
        ),
        "rooms": len(graph),
        "floors": floors(graph),
        "arrows between rooms": sum(map(len, graph.values())),
        "branches on None in the core": sum(
            len(re.findall(r"is None|is not None|in_rigs", text))
            for path, text in python.items()
            if room(path) in CORE
        ),
        **plainness(python.values()),
        "words of documents": sum(len(path.read_text().split()) for path in documents),
        "inner imports in tests": inner_imports(root),
    }


@dataclass
class Walk:
    """Functions of the package that a value enters as an argument, in order."""

    takes: Callable[[str, Any], bool]
    """Whether an argument, by its name and value, is the one to follow."""

    stays: list[tuple[str, str]] = field(default_factory=list)
    """Module and function; one that follows itself is there once."""

    def __call__(self, frame: FrameType, event: str, argument: object) -> None:
        """Watches a call, as `sys.setprofile` asks for it."""
        module = frame.f_globals.get("__name__", "")
        if event != "call" or not module.startswith("jaxba."):
            return
        code = frame.f_code
        names = code.co_varnames[: code.co_argcount + code.co_kwonlyargcount]
        stay = (module, code.co_qualname)
        if self.stays[-1:] != [stay] and any(
            self.takes(name, frame.f_locals.get(name)) for name in names
        ):
            self.stays.append(stay)

    def follow(self, work: Callable[[], object]) -> str:
        """Stays, moves between rooms, and moves into a room that imports the one before, while
        `work` runs."""
        sys.setprofile(self)
        try:
            work()
        finally:
            sys.setprofile(None)
        rooms = [module.split(".")[1] for module, _ in self.stays]
        moves = [pair for pair in pairwise(rooms) if pair[0] != pair[1]]
        graph = arrows(sources(Path(jaxba.__file__).parents[1]))
        climbs = sum(before in graph[after] for before, after in moves)
        return f"{len(rooms)} stays, {len(moves)} moves, {climbs} climbs"


def walks() -> dict[str, str]:
    """Walks of a problem through `solve`, and of the damping and the layout through one step."""
    problem = jaxba.random_scene(jaxba.SceneConfig(cameras=4, points=40, observations=120), seed=0)
    options = jaxba.SolveOptions(max_iterations=1)
    ready = jaxba.prepare(problem, options=options)

    def trace_step() -> None:
        jax.clear_caches()  # else the second trace would be the first
        jax.eval_shape(
            partial(jaxba.lm_step, ready.layout, options=ready.options),
            ready.state,
            jnp.asarray(1e-4),
        )

    return {
        "`problem` through `solve`": Walk(
            lambda name, value: isinstance(value, jaxba.BundleProblem)
        ).follow(lambda: jaxba.solve(problem, options=options)),
        "damping through `lm_step`": Walk(lambda name, value: name == "damping").follow(trace_step),
        "`layout` through `lm_step`": Walk(lambda name, value: name == "layout").follow(trace_step),
    }


def main() -> None:
    """Prints the table."""
    jax.config.update("jax_enable_x64", True)
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path.cwd()
    for name, value in counts(root).items():
        print(f"{name:42} {value:8,}")
    for name, walk in walks().items() if root == Path.cwd() else ():
        print(f"{name:42} {walk}")


if __name__ == "__main__":
    main()
