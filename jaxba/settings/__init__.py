"""Strict conversion between nested frozen dataclasses and plain data, as a YAML file holds it.

Unknown keys and values of a wrong type or that the class refuses raise an error of one line with
the key's path."""

from __future__ import annotations

import dataclasses
import difflib
import re
import types
import typing
from collections.abc import Mapping
from typing import Any, Literal, TypeVar, get_args, get_origin

from jaxba.io.json_lines import plain
from jaxba.problem.checks import shown
from jaxba.settings.configurations import SettingsError

Settings = TypeVar("Settings")

# numbers such as 3e-4, which YAML 1.1 reads as text
_SCIENTIFIC = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+")

_SCALARS = {float: "a number", int: "a whole number", bool: "true or false", str: "text"}


def read(kind: type[Settings], data: Any, path: str = "") -> Settings:
    """An instance of a dataclass of numbers, strings, literals, tuples, optional values and further
    dataclasses, from a mapping by field name; missing keys have their defaults. `path` is that of
    the mapping inside a larger one, for messages. Raises SettingsError: with the key and what it
    should be."""
    if not isinstance(data, Mapping):
        raise SettingsError(f"{path or 'settings'} must be a mapping, is {_show(data)}")
    types_by_name = {key: _type_of(kind, key, _join(path, key)) for key in data}
    values = {
        key: _value(types_by_name[key], value, _join(path, key)) for key, value in data.items()
    }
    try:
        return kind(**values)
    except ValueError as error:
        raise SettingsError(f"{path}: {error}" if path else str(error)) from None
    except TypeError as error:  # a field without default
        raise SettingsError(f"{path or 'settings'}: {str(error).rpartition('() ')[2]}") from None


def field_types(kind: type) -> dict[str, Any]:
    """Types of the fields of a dataclass by name."""
    hints = typing.get_type_hints(kind)
    return {field.name: hints[field.name] for field in dataclasses.fields(kind)}


def to_yaml(value: Any) -> str:
    """The text of a YAML file with all settings, defaults included."""
    import yaml

    return yaml.safe_dump(plain(value), sort_keys=False)


def assign(data: dict[str, Any], path: str, value: Any, kind: type) -> None:
    """Sets one value, plain data, inside the nested mappings `data` of a dataclass; missing
    mappings are created. `path` has the keys, joined by dots. Raises SettingsError: there is no
    such key, or the path continues below a value."""
    *above, last = path.split(".")
    for depth, key in enumerate(above, 1):
        kind = _type_of(kind, key, path)
        inside = ".".join(above[:depth])
        if not dataclasses.is_dataclass(kind):
            raise SettingsError(f"unknown key {path}; {inside} has no parts")
        inner = data.setdefault(key, {})
        data = {} if inner is None else inner
        if not isinstance(data, dict):
            raise SettingsError(f"{inside} must be a mapping, is {_show(data)}")
    _type_of(kind, last, path)
    data[last] = value


def differences(one: Any, other: Any, path: str = "") -> list[str]:
    """Paths of the fields in which two settings of one class differ."""
    if dataclasses.is_dataclass(one) and type(one) is type(other):
        names = [field.name for field in dataclasses.fields(one)]
        return [
            x
            for n in names
            for x in differences(getattr(one, n), getattr(other, n), _join(path, n))
        ]
    return [] if one == other else [path]


def _value(kind: Any, value: Any, path: str) -> Any:
    origin = get_origin(kind)
    inside = get_args(kind)
    if origin in (typing.Union, types.UnionType):
        if value is None and type(None) in inside:
            return None
        rest = [x for x in inside if x is not type(None)]
        return _value(rest[0], value, path)
    if origin is Literal:
        if value is False and "off" in inside:
            value = "off"  # YAML 1.1 reads the word as false
        if value not in inside or isinstance(value, bool) != any(
            isinstance(x, bool) for x in inside
        ):
            raise SettingsError(
                f"{path} must be one of {', '.join(map(str, inside))}, is {_show(value)}"
            )
        return value
    if origin is tuple:
        if not isinstance(value, (list, tuple)):
            raise SettingsError(f"{path} must be a list, is {_show(value)}")
        return tuple(_value(inside[0], item, f"{path}[{k}]") for k, item in enumerate(value))
    if dataclasses.is_dataclass(kind) and isinstance(kind, type):
        return read(kind, value, path)
    return _scalar(kind, value, path)


def _scalar(kind: Any, value: Any, path: str) -> Any:
    if (kind, type(value)) == (float, str) and _SCIENTIFIC.fullmatch(value):
        value = float(value)
    fits = isinstance(value, (int, float) if kind is float else kind) and isinstance(
        value, bool
    ) == (kind is bool)
    if fits and (kind is not float or abs(value) < float("inf")):
        return kind(value)
    quotes = ": put it in quotes" if kind is str else ""
    raise SettingsError(f"{path} must be {_SCALARS[kind]}, is {_show(value)}{quotes}")


def _join(path: str, key: Any) -> str:
    return f"{path}.{key}" if path else str(key)


def _type_of(kind: type, key: Any, path: str) -> Any:
    """The type of a field of a dataclass; `path` names it in messages. Raises SettingsError."""
    known = field_types(kind)
    if key not in known:
        near = difflib.get_close_matches(str(key), known, n=3, cutoff=0.5)
        hint = f"did you mean {' or '.join(near)}?" if near else f"known: {', '.join(known)}"
        raise SettingsError(f"unknown key {path}; {hint}")
    return known[key]


def _show(value: Any) -> str:
    return "a mapping" if isinstance(value, Mapping) else shown(value, 40)
