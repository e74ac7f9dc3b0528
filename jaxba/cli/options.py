"""The options of a command: a dataclass from which tyro makes the parser, and the help that it
prints."""

from __future__ import annotations

import ast
import inspect
import re
import sys
from collections.abc import Sequence
from contextlib import redirect_stderr
from dataclasses import dataclass, field, is_dataclass, make_dataclass
from functools import cache
from io import StringIO
from itertools import pairwise
from types import NoneType, UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    TypeVar,
    Union,
    dataclass_transform,
    get_args,
    get_origin,
    get_type_hints,
)

import tyro

BAD_INPUT = 2  # exit status for invalid input

Arguments = TypeVar("Arguments")

_COLORS = re.compile(r"\x1b\[[\d;]*m")  # control sequences that colour text on a terminal


@dataclass_transform(frozen_default=True)
def options(cls: type[Arguments]) -> type[Arguments]:
    """Makes a frozen dataclass of options, or gives one its help.

    The text below a field is its help, whatever the lengths of its lines. A text in the annotation,
    `Annotated[str, "FILE"]`, stands for the value in the help; one like "-o" is a short name. A
    class that inherits from several such classes has their options, in the help a group for each
    class."""
    texts = _texts(cls)
    hints = get_type_hints(cls, include_extras=True)
    for name in cls.__annotations__:
        default = getattr(cls, name, None)
        kind, *extras = (
            get_args(hints[name]) if get_origin(hints[name]) is Annotated else [hints[name]]
        )
        words = [extra for extra in extras if isinstance(extra, str)]
        short_names = [word for word in words if word.startswith("-")]
        metavars = [word for word in words if not word.startswith("-")]
        shown = tyro.conf.arg(
            help=texts.get(name),
            aliases=short_names or None,
            metavar=metavars[0] if metavars else _metavar(kind),
            help_behavior_hint="" if default is None or default is False or default == () else None,
            prefix_name=False,
        )
        own = [extra for extra in extras if not isinstance(extra, str)]
        cls.__annotations__[name] = Annotated[(kind, shown, *own)]  # pyright: ignore[reportInvalidTypeForm]
    return cls if "__dataclass_fields__" in vars(cls) else dataclass(frozen=True)(cls)


@cache
def _classes(module: str) -> dict[str, Any]:
    """The syntax trees of the classes of a module, by name."""
    try:
        body = ast.parse(inspect.getsource(sys.modules[module])).body
    except OSError:  # installed without source
        return {}
    return {one.name: one for one in body if isinstance(one, ast.ClassDef)}


def _texts(cls: type) -> dict[str, str]:
    """The text below each field of a class, in one line."""
    found = _classes(cls.__module__).get(cls.__name__)
    pairs = pairwise(found.body if found else ())
    fields = [
        pair
        for pair in pairs
        if isinstance(pair[0], ast.AnnAssign) and isinstance(pair[1], ast.Expr)
    ]
    return {name.target.id: " ".join(text.value.value.split()) for name, text in fields}


def _metavar(kind: Any) -> str | None:
    """What stands for the value of an option that may be absent; None for tyro's own."""
    if get_origin(kind) not in (Union, UnionType):
        return None
    kind = next(one for one in get_args(kind) if one is not NoneType)
    return (
        f"{{{','.join(get_args(kind))}}}" if get_origin(kind) is Literal else kind.__name__.upper()
    )


def parse(
    arguments: type[Arguments], description: str, program: str, argv: Sequence[str] | None
) -> Arguments | str | None:
    """The parsed command line, or what is wrong with it, in one line; None after `--help`.

    Args:
        arguments: the class of the options.
        description: first line of the help.
        program: name of the command.
        argv: the command line; `sys.argv[1:]` if None."""
    groups = [base for base in arguments.__bases__ if is_dataclass(base)]
    # subclasses, without the docstrings, which tyro would print
    made = [type(base.__name__, (base,), {}) for base in groups]
    parts = [(part.__name__.lower(), part, field(default_factory=part)) for part in made]
    drawn = StringIO()
    try:
        with redirect_stderr(drawn):
            kind = make_dataclass("Options", parts) if groups else arguments
            parsed = tyro.cli(kind, prog=program, args=argv, description=description)
    except SystemExit as end:
        return _error(drawn.getvalue()) if end.code == BAD_INPUT else None
    if not groups:
        return parsed  # pyright: ignore[reportReturnType]
    return arguments(
        **{name: value for group in vars(parsed).values() for name, value in vars(group).items()}
    )


def _error(drawn: str) -> str:
    """The message of tyro in one line.

    It is a box: the title, a rule, the message, a rule, help on the option or options with a
    similar name, a rule, and how to get help. In an encoding that has lines the title stands in the
    first rule, and lines are its border."""
    text = _COLORS.sub("", drawn)
    parts = re.split(r"^(?:╭.*|[│ ]*[─-]{3,}.*)$", text, flags=re.MULTILINE)
    message = (
        " ".join(re.sub(r"^│|│$", "", parts[1], flags=re.MULTILINE).split())
        if len(parts) > 1
        else text
    )
    message = _in_plain_words(message)
    near = re.findall(r"^. {5}(--[\w-]+)", text.partition("Perhaps you meant:")[2], re.MULTILINE)
    return f"{message}{'; perhaps you meant ' if near else ''}{' or '.join(near)}"


_KINDS = {"int": "a whole number", "float": "a number"}
"""What a message calls the types of values."""


def _in_plain_words(message: str) -> str:
    """A message of tyro about one value, without its and Python's words; others as they are."""
    parsed = re.match(r"Error parsing (\S+): ", message)
    failed = r"invalid literal for (int)\(\) with base 10|could not convert string to (float)"
    value = re.search(rf"(?:{failed}): (.*)$", message)
    if parsed and value:
        kind = _KINDS[value[1] or value[2]]
        return f"{parsed[1]} must be {kind}, not {value[3]}"
    choice = re.match(
        r"invalid choice (.*) for argument '(.*)'\. Expected one of \((.*)\)\.$", message
    )
    if choice:
        # tyro has them in any order
        known = sorted({*re.findall(r"'([^']*)'", choice[3])} - {"None"})
        return f"{choice[2]} must be one of {', '.join(known)}, not {choice[1]}"
    missing = re.match(r"Missing value for argument '(.*)'\. Expected 1 values\.$", message)
    return f"{missing[1]} needs a value" if missing else message
