"""Tables of options and commands for the documents, made from the source when the site is built.

A line `<!-- fields of: jaxba.StepOptions -->` in a page becomes a table of the fields of that
dataclass; `<!-- options of: jaxba.cli.solve.Arguments -->` one of a command's options. The source
is read, not imported, so that a build needs no JAX. mkdocs calls `on_page_markdown` (`hooks` in
mkdocs.yml).

`python docs/generate.py` counts the words of README and of the pages that are written by hand.
"""

from __future__ import annotations

import ast
import functools
import re
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parent.parent

MARKER = re.compile(r"^<!-- (fields|options) of: ([\w.]+) -->$", re.MULTILINE)

GENERATED = ("results/paper.md", "reference/api/")
"""Pages, or folders of pages, that are made from something else and so are not counted."""


class DocumentError(Exception):
    """A page asks for a table that cannot be made."""


@functools.cache
def _package() -> Any:
    import griffe

    loader = griffe.GriffeLoader(search_paths=[ROOT], allow_inspection=False)
    package = loader.load("jaxba", submodules=True)
    loader.resolve_aliases()
    return package


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Puts the tables where a page asks for them."""
    return MARKER.sub(lambda match: table(match[2], command=match[1] == "options"), markdown)


def table(path: str, *, command: bool) -> str:
    """The fields of a dataclass as a Markdown table.

    Args:
        path: of the class, such as `jaxba.cli.solve.Arguments`.
        command: whether the fields are options of a command.

    Raises:
        DocumentError: there is no such class, or it has no fields.
    """
    try:
        found = _package()[path.removeprefix("jaxba.")]
        found = found.final_target if found.is_alias else found
    except KeyError:
        raise DocumentError(f"{path}: no such class") from None
    members = [m for m in found.members.values() if m.is_attribute and m.annotation is not None]
    fields = [m for m in members if "property" not in m.labels]
    if not fields:
        raise DocumentError(f"{path}: no fields")
    rows = [f"| {'option' if command else 'field'} | default | meaning |", "| --- | --- | --- |"]
    for field in fields:
        annotation = str(field.annotation)
        default = _value(found, field.value)
        name = f"`{_option(field.name, annotation)}`" if command else f"`{field.name}`"
        choices = ", ".join(f"`{choice}`" for choice in _choices(found, annotation))
        words = " ".join(field.docstring.value.split()) if field.docstring else ""
        meaning = (
            f"{_plain(words)} One of {choices}."
            if choices and _any_missing(choices, words)
            else _plain(words)
        )
        shown = "" if default in ("", "None") else f"`{default}`"
        rows.append(
            "| " + " | ".join(cell.replace("|", "\\|") for cell in (name, shown, meaning)) + " |"
        )
    return "\n".join(rows)


def _plain(words: str) -> str:
    """Words as they are: signs that Markdown would take for its own are escaped, except in code."""
    parts = words.split("`")
    parts[::2] = [re.sub(r"([*<\[\]])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)


def _option(name: str, annotation: str) -> str:
    """How a field is written on the command line."""
    named = re.search(r"name='([\w-]+)'", annotation)
    option = (named[1] if named else name).replace("_", "-")
    if "Positional" in annotation:
        return option.upper()
    return f"--{option}"


def _value(owner: Any, value: Any) -> str:
    """A default as text."""
    if value is None:
        return ""
    text = _text(owner.parent, ast.parse(str(value), mode="eval").body)
    return "" if text == "()" else re.sub(r"e([+-])0(\d)", r"e\1\2", text)


def _text(module: Any, value: ast.expr) -> str:
    """What an expression stands for where it names constants, or fields of instances; else its own
    text."""
    if isinstance(value, ast.Constant) and isinstance(value.value, str):
        return value.value
    if isinstance(value, ast.Call) and ast.unparse(value.func).endswith("field"):
        factory = next(
            (word.value for word in value.keywords if word.arg == "default_factory"), None
        )
        return f"{ast.unparse(factory)}()" if factory is not None else ""
    if isinstance(value, ast.Name):
        found = _member(module, value.id)
        if found is not None and found.is_attribute and found.value is not None:
            return _text(found.parent, ast.parse(str(found.value), mode="eval").body)
    if isinstance(value, ast.Attribute):
        kind = _class_of(module, value.value)
        field = kind and _member(kind, value.attr)
        if field:
            return _text(kind.parent, ast.parse(str(field.value), mode="eval").body)
    return ast.unparse(value)


def _class_of(module: Any, value: ast.expr) -> Any:
    """The class of an instance whose fields have their defaults; None where that is not told by the
    source."""
    if isinstance(value, ast.Name):
        found = _member(module, value.id)
        if found is None or not found.is_attribute:
            return None
        return _class_of(found.parent, ast.parse(str(found.value), mode="eval").body)
    if isinstance(value, ast.Attribute):
        kind = _class_of(module, value.value)
        field = kind and _member(kind, value.attr)
        if not field:
            return None
        call = ast.parse(str(field.value), mode="eval").body
        factory = [
            word.value for word in getattr(call, "keywords", []) if word.arg == "default_factory"
        ]
        return (
            _class_of(kind.parent, ast.Call(factory[0], [], []))
            if factory
            else _class_of(kind.parent, call)
        )
    if (
        isinstance(value, ast.Call)
        and not value.args
        and not value.keywords
        and isinstance(value.func, ast.Name)
    ):
        found = _member(module, value.func.id)
        return found if found is not None and found.is_class else None
    return None


def _member(owner: Any, name: str) -> Any:
    """A member of a module or class by name, what it is imported from included; None where there is
    none."""
    try:
        found = owner[name]
        return found.final_target if found.is_alias else found
    except (KeyError, AttributeError):
        return None


def _choices(owner: Any, annotation: str) -> list[str]:
    """The values that a Literal, or a name that stands for one, allows."""
    found = _member(owner.parent, annotation) if annotation.isidentifier() else None
    annotation = str(found.value) if found is not None and found.is_attribute else annotation
    match = re.search(r"Literal\[(.*?)\]", annotation)
    return [str(x) for x in ast.literal_eval(f"({match[1]},)")] if match else []


def _any_missing(choices: str, words: str) -> bool:
    """Whether the words leave out one of the choices."""
    return any(choice.strip("` ") not in words for choice in choices.split(","))


def navigation() -> list[str]:
    """The pages in the navigation, relative to `docs`, in order."""
    text = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    return re.findall(r"^ +- .*: ([\w/-]+\.md)$", text, re.MULTILINE)


def count_words() -> dict[str, int]:
    """Words of README and of every page that is written by hand, as `wc -w` counts them."""
    pages = ["../README.md", *(page for page in navigation() if not page.startswith(GENERATED))]
    return {page: len((ROOT / "docs" / page).read_text(encoding="utf-8").split()) for page in pages}


if __name__ == "__main__":
    counts = count_words()
    for page, count in counts.items():
        print(f"{count:6} {page}")
    print(f"{sum(counts.values()):6} words")
