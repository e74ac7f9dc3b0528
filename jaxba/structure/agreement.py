"""What the layouts of the shards of a problem must have in common: sizes of arrays, and lists of
blocks."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np


class Agreement:
    """Asked by name by the layout of one of several shards, with what it needs itself; knows what
    all of them need as far as it was found in the round before. `ALONE` is that of the only shard,
    which needs nothing more."""

    def __init__(self, known: dict[str, Any] | None, common: dict[str, Any]) -> None:
        """`known` was found in the round before, `common` is what the shards of this round have in
        common so far."""
        self._known = known
        self._common = common
        self._prefix = ""
        self.found: dict[str, Any] = {}

    def within(self, name: str) -> Agreement:
        """The same for a part, whose names begin with that of the part."""
        part = copy.copy(self)
        part._prefix = f"{self._prefix}{name}."
        return part

    def size(self, name: str, own: int) -> int:
        """The largest of a number in all shards."""
        return max(own, self._asked(name, own))

    def others(self, name: str, own: Callable[[], np.ndarray]) -> np.ndarray:
        """Sorted keys of all shards; none if there are no others."""
        return np.zeros(0, np.int64) if self._known is None else self.union(name, np.unique(own()))

    def union(self, name: str, own: np.ndarray) -> np.ndarray:
        """The sorted union of keys, sorted ones, in all shards."""
        return np.union1d(own, self._asked("union " + name, own))

    def total(self, name: str, own: Callable[[], Any]) -> Any:
        """The sum over all shards of an array or a sparse matrix, which depends on nothing else
        that is asked for."""
        key = f"{self._prefix}total {name}"
        return (
            self._known[key]
            if self._known and key in self._known
            else self._asked("total " + name, own())
        )

    def once(self, name: str, value: Callable[[], Any]) -> Any:
        """A value that depends on totals and what else all shards have in common."""
        if self._known is None:
            return value()
        key = self._prefix + name
        if key not in self._common:
            self._common[key] = value()
        return self._common[key]

    def _asked(self, name: str, own: Any) -> Any:
        if self._known is None:
            return own
        self.found[self._prefix + name] = own
        return self._known.get(self._prefix + name, own)


ALONE = Agreement(None, {})


def merged(found: list[dict[str, Any]], known: dict[str, Any]) -> dict[str, Any]:
    """What all shards need, with the totals of the rounds before."""
    result = {key: value for key, value in known.items() if _kind(key) == "total"}
    for key in dict.fromkeys(name for one in found for name in one):
        values = [one[key] for one in found if key in one]
        kind = _kind(key)
        if kind == "union":
            result[key] = np.unique(np.concatenate(values))
        else:
            result[key] = sum(values[1:], values[0]) if kind == "total" else max(values)
    return result


def _kind(key: str) -> str:
    return key.rpartition(".")[2].partition(" ")[0]


def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
    """Whether two rounds found the same."""

    def equal(a, b):
        return (a != b).nnz == 0 if hasattr(a, "nnz") else np.array_equal(a, b)

    return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
