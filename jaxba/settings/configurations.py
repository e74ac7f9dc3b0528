"""Configuration files `configs/KIND/NAME.yaml`: how they are found by name, and how one extends
another.

An installed jaxba carries copies of them, which setup.py puts there; in a clone they lie beside the
package. A file may begin with `extends: BASE`, the name of a configuration or a path relative to
the file. It then states differences to its base: mappings are merged key by key, everything else,
lists too, replaces what the base says."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, TypeAlias

from jaxba.io.encoding import plain_text
from jaxba.io.files import display_name, reason, visible
from jaxba.typing import InputError

# command that reads a configuration, and its folder's name
Kind: TypeAlias = Literal["train", "paper", "bench"]
BASE = "extends"  # key of a file that names its base

_PACKAGE = Path(__file__).resolve().parents[1]


class SettingsError(InputError):
    """Settings that cannot be used. The message is one line for a person."""


def names(kind: Kind) -> list[str]:
    """Names that `find` knows, sorted."""
    return sorted(path.stem for path in visible(_folder(kind)) if path.suffix == ".yaml")


def find(kind: Kind, name: str, folder: Path = Path()) -> Path:
    """Where a configuration lies: one of `names`, or the path of a file, relative to `folder`:
    anything with a slash or an ending. Raises SettingsError: there is no such name. Whether the
    file of a path exists is not looked at."""
    if len(Path(name).parts) != 1 or Path(name).suffix:
        return folder / name
    if name not in names(kind):
        known = ", ".join(names(kind))
        raise SettingsError(f"no configuration {name!r}; known: {known}, or the path of a file")
    return _folder(kind) / f"{name}.yaml"


def read(kind: Kind, name: str) -> dict[str, Any]:
    """What a configuration (one of `names`, or the path of a file) says, its bases included; an
    empty file says nothing. It is plain data, a new object with each call. Raises SettingsError: no
    such configuration or base, no YAML, no mapping, or files that extend each other in a circle."""
    path = find(kind, name)
    data = read_file(path, name)
    shown = [name]
    visited = [path.resolve()]
    layers = [data]
    while BASE in data:
        base = data.pop(BASE)
        if not isinstance(base, str):
            raise SettingsError(
                f"{shown[-1]}: {BASE} must be a name or the path of a file, is {base!r}"
            )
        try:
            path = find(kind, base, path.parent)
            data = read_file(path, display_name(base))
        except SettingsError as error:
            raise SettingsError(f"{shown[-1]}: {BASE}: {error}") from None
        shown.append(display_name(base))
        if path.resolve() in visited:
            raise SettingsError(f"{' extends '.join(shown)}: a circle")
        visited.append(path.resolve())
        layers.append(data)
    merged: dict[str, Any] = {}
    for layer in reversed(layers):
        merged = _merge(merged, layer)
    return merged


def parse(text: str, name: str, *, as_text: bool = False) -> Any:
    """Plain data from YAML; `name` is for messages. With `as_text` all scalars stay the text that
    they are, as names must: `000010`, `1_000`, `yes`, `null`. Raises SettingsError: not YAML, or a
    mapping has a key twice."""
    import yaml

    def where(mark):
        return f" line {mark.line + 1}" if mark and "\n" in text.strip() else ""

    try:
        loader = (yaml.BaseLoader if as_text else yaml.SafeLoader)(text)
        node = loader.get_single_node()
        twice = _twice(node)
        if twice is not None:
            raise SettingsError(f"{name}{where(twice.start_mark)}: {twice.value} is there twice")
        return None if node is None else loader.construct_document(node)
    except (yaml.YAMLError, RecursionError) as error:
        raise SettingsError(
            f"{name}{where(getattr(error, 'problem_mark', None))}: not YAML"
        ) from None


def _twice(root: Any) -> Any:
    """A key that a mapping below a node of YAML has twice, so that one of its values would not
    count; or None."""
    waiting = [root]
    known = set()
    while waiting:
        node = waiting.pop()
        if id(node) in known or not isinstance(getattr(node, "value", ""), list):
            continue
        known.add(id(node))  # nodes with an alias may hold themselves
        pairs = [pair for pair in node.value if isinstance(pair, tuple)]
        waiting += [part for pair in pairs for part in pair] or node.value
        keys = set()
        for key, _ in pairs:
            if (key.tag, str(key.value)) in keys:
                return key
            keys.add((key.tag, str(key.value)))
    return None


def _folder(kind: Kind) -> Path:
    """The copies inside an installed package; in a clone, what they would be copies of."""
    installed = _PACKAGE / "configs" / kind
    return installed if installed.is_dir() else _PACKAGE.parent / "configs" / kind


def read_file(path: Path, name: str, *, as_text: bool = False) -> dict[str, Any]:
    """The mapping in a YAML file; an empty file says nothing. Arguments as for `parse`. Raises
    SettingsError: it cannot be read, or is no mapping; `name` says which file."""
    try:
        text = plain_text(path.read_bytes()).decode()
    except UnicodeDecodeError:
        raise SettingsError(f"{name}: not text") from None
    except (OSError, ValueError) as error:  # ValueError: a name with a null character
        raise SettingsError(f"{name}: {reason(error)}") from None
    data = parse(text, name, as_text=as_text)
    if data is None or data == "":
        return {}
    if not isinstance(data, dict):
        raise SettingsError(f"{name}: must be a mapping of settings to their values")
    return data


def _merge(base: Mapping[str, Any], top: Mapping[str, Any]) -> dict[str, Any]:
    merged = dict(base)
    for key, value in top.items():
        below = merged.get(key)
        merged[key] = (
            _merge(below, value) if isinstance(below, dict) and isinstance(value, dict) else value
        )
    return merged
