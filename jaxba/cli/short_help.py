"""The first of two steps of help: the options of every day, and examples."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from typing import Any, Literal, get_args, get_origin

WIDTH = 80  # columns
TEXT_COLUMN = 24  # where the texts of options begin

HELP_ALL = "--help-all"
"""The option that shows all others."""


def short_help(
    arguments: type[Any],
    program: str,
    description: str,
    everyday: Sequence[str],
    examples: Sequence[tuple[str, str]],
) -> str:
    """A page of help.

    Args:
        arguments: the class of the options, made by `jaxba.cli.options.options`.
        program: name of the command.
        description: what it does, in one sentence.
        everyday: fields of the options that are shown.
        examples: command lines, and what each does."""
    lines = [f"usage: {program} [OPTIONS] [PROBLEM ...]", "", description, "", "examples:"]
    for command, purpose in examples:
        lines += [f"  {command}", f"      {purpose}"]
    lines += ["", "everyday options:"]
    for name in everyday:
        lines += _lines_of(name, *_described(arguments, name))
    lines += _entry(HELP_ALL, "Show all options.")
    lines += _entry("--version", "Show the versions of jaxba, JAX and Python.")
    return "\n".join(lines)


def _described(arguments: type[Any], name: str) -> tuple[Any, Any]:
    """The type of an option, and what `options` knows of it: its help, and what stands for its
    value."""
    for base in arguments.__mro__:
        if name in vars(base).get("__annotations__", {}):
            kind, described, *_ = get_args(base.__annotations__[name])
            return kind, described
    raise KeyError(name)


def _lines_of(name: str, kind: Any, described: Any) -> list[str]:
    """The lines of an option."""
    names = [*(described.aliases or ()), f"--{name.replace('_', '-')}"]
    value = described.metavar
    if value is None and get_origin(kind) is Literal:
        value = f"{{{','.join(get_args(kind))}}}"
    elif value is None and kind is not bool:
        value = kind.__name__.upper()
    return _entry(" ".join([", ".join(names), value or ""]).rstrip(), described.help or "")


def _entry(head: str, text: str) -> list[str]:
    """An option and its text, beside each other if there is room."""
    rest = textwrap.wrap(text, WIDTH - TEXT_COLUMN)
    lines = [" " * TEXT_COLUMN + line for line in rest]
    if len(head) + 4 > TEXT_COLUMN:
        return [f"  {head}", *lines]
    first = f"  {head}".ljust(TEXT_COLUMN)
    return [first + (rest[0] if rest else ""), *lines[1:]]
