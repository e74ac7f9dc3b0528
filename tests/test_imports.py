"""Which way imports point: a room of the package knows the rooms below it, and nothing of those
above.

Imports inside of functions and those for type checkers count as well.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import pytest
from conftest import LABORATORY

import jaxba

ORDER = (
    *(
        "typing",
        "runtime",
        "rotations",
        "problem",
        "residuals",
        "io",
        "settings",
        "scenes",
        "structure",
        "model",
        "linear",
    ),
    *(
        "refinement",
        "lm",
        "damping",
        "solver",
        "results",
        "constraints",
        "datasets",
        "viewer",
        "jaxba",
    ),
    *("methods", "kitti", "game", "training", "peers", "bench", "paper", "cli", "__main__"),
)
"""Rooms from bottom to top; `jaxba` is the package's own `__init__.py`. Each may import itself and
all before it."""

NO_MORE_THAN = {
    "residuals": {"typing", "runtime", "rotations", "problem"},
    "runtime": {"typing"},
    "io": {"typing", "runtime", "problem"},
    "settings": {"typing", "runtime", "problem", "io"},
    "scenes": {"typing", "runtime", "problem"},
    "datasets": {"typing", "runtime", "problem", "io"},
    "kitti": {"typing", "runtime", "problem", "io"},
}
"""Rooms that know less than all that stand before them."""

LABORATORY_COMMANDS = {f"jaxba.cli.{name}" for name in ("bench", "train", "kitti", "paper")}
"""Modules of commands that belong to them."""

DOOR = ("jaxba", "jaxba.training.api")
"""The one arrow that is not one: `jaxba` names these functions for type checkers, and loads them
when they are asked for."""

MOST_BRANCHES = 115
"""Most branches on None, and on rigs, of all rooms of the core. It only falls: a feature is a value
that knows what it is, such as `structure.sharing.Sharing`, so that its users need not ask."""

PACKAGE = Path(jaxba.__file__).parent
SOURCES = {
    ".".join(("jaxba", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
        ".__init__"
    ): path.read_text()
    for path in PACKAGE.rglob("*.py")
}
"""Source text of every module by its name."""


def imports(source: str) -> Iterator[str]:
    """Modules of jaxba that a source text imports."""
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            names = [name.name for name in node.names]
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "imports are absolute"
            within = [f"{node.module}.{name.name}" for name in node.names]
            names = [name if name in SOURCES else str(node.module) for name in within]
        else:
            continue
        yield from (name for name in names if name.partition(".")[0] == "jaxba")


def room_of(module: str) -> str:
    """Room in which a module stands."""
    parts = module.split(".")
    return parts[1] if len(parts) > 1 else module


def turned_arrows(room: str, sources: dict[str, str]) -> list[str]:
    """Imports that modules of a room should not have, as `module: import`."""
    known = NO_MORE_THAN.get(room, set(ORDER[: ORDER.index(room)]))
    return [
        f"{module}: {name}"
        for module, source in sources.items()
        if room_of(module) == room
        for name in imports(source)
        if room_of(name) != room and room_of(name) not in known and (module, name) != DOOR
    ]


@pytest.mark.parametrize("room", ORDER)
def test_a_room_knows_nothing_of_those_above(room):
    assert turned_arrows(room, SOURCES) == []


def in_laboratory(module: str) -> bool:
    """Whether a module belongs to the laboratory."""
    return room_of(module) in LABORATORY or module in LABORATORY_COMMANDS


def test_the_library_imports_nothing_of_the_laboratory():
    library = {module: source for module, source in SOURCES.items() if not in_laboratory(module)}
    arrows = [
        (module, name)
        for module, source in library.items()
        for name in imports(source)
        if in_laboratory(name)
    ]
    assert set(arrows) <= {DOOR}


def test_import_jaxba_loads_nothing_of_the_laboratory():
    program = (
        "import sys, jaxba; print(*(name for name in sys.modules if name.startswith('jaxba.')))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, check=True
    ).stdout.split()
    assert "jaxba.solver.solve" in loaded
    assert [name for name in loaded if in_laboratory(name)] == []


def test_what_may_be_absent_is_a_value_and_seldom_a_branch():
    branches = re.compile("is None|is not None|in_rigs")
    core = ("structure", "model", "linear", "refinement", "lm", "solver", "results")
    found = sum(
        len(branches.findall(source))
        for module, source in SOURCES.items()
        if room_of(module) in core
    )
    assert found <= MOST_BRANCHES


def test_every_room_has_its_place_in_the_order():
    assert {room_of(module) for module in SOURCES} == set(ORDER)


@pytest.mark.parametrize(
    ("module", "source", "found"),
    [
        ("jaxba.linear.schur", "from jaxba.lm.step import lm_step", "jaxba.lm.step"),
        ("jaxba.lm.step", "def f():\n    import jaxba.solver.methods", "jaxba.solver.methods"),
        ("jaxba.solver.solve", "from jaxba.methods import stba", "jaxba.methods.stba"),
        ("jaxba.game.env", "if TYPE_CHECKING:\n    from jaxba import bench", "jaxba.bench"),
        ("jaxba.io.bal", "from jaxba.structure import layout", "jaxba.structure.layout"),
        ("jaxba.damping.rules", "import jaxba", "jaxba"),
    ],
)
def test_a_turned_arrow_is_found(module, source, found):
    assert turned_arrows(room_of(module), {module: source}) == [f"{module}: {found}"]


def test_modules_do_not_import_each_other_in_circles():
    try:
        TopologicalSorter(
            {module: set(imports(source)) for module, source in SOURCES.items()}
        ).prepare()
    except CycleError as error:
        pytest.fail(" <- ".join(error.args[1]))
