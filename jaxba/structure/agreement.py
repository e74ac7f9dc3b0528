"""What the layouts of the shards of a problem must have in common: sizes of arrays, and lists of blocks."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np


class Agreement:
    """What a layout asks by name, with what it needs itself: here that of the only shard, which needs nothing more."""

    def within(self, name: str) -> Agreement:
        """The same for a part, whose names begin with that of the part."""
        return self

    def size(self, name: str, own: int) -> int:
        """The largest of a number in all shards."""
        return own

    def others(self, name: str, own: Callable[[], np.ndarray]) -> np.ndarray:
        """Sorted keys of all shards; none if there are no others."""
        return np.zeros(0, np.int64)

    def union(self, name: str, own: np.ndarray) -> np.ndarray:
        """The sorted union of keys, sorted ones, in all shards."""
        return own

    def total(self, name: str, own: Any) -> Any:
        """The sum over all shards of an array or a sparse matrix."""
        return own


ALONE = Agreement()


class Round(Agreement):
    """What one of several shards needs, and what all need as far as it is known from the round before."""

    def __init__(self, known: dict[str, Any], found: dict[str, Any] | None = None, prefix: str = "") -> None:
        self._known = known
        self._prefix = prefix
        self.found: dict[str, Any] = {} if found is None else found

    def within(self, name: str) -> Agreement:
        """See `Agreement`."""
        return Round(self._known, self.found, f"{self._prefix}{name}.")

    def size(self, name: str, own: int) -> int:
        """See `Agreement`."""
        self.found[self._prefix + name] = own
        return max(own, self._known.get(self._prefix + name, own))

    def others(self, name: str, own: Callable[[], np.ndarray]) -> np.ndarray:
        """See `Agreement`."""
        return self.union(name, np.unique(own()))

    def union(self, name: str, own: np.ndarray) -> np.ndarray:
        """See `Agreement`."""
        key = self._prefix + "union " + name
        self.found[key] = own
        return np.union1d(own, self._known.get(key, own))

    def total(self, name: str, own: Any) -> Any:
        """See `Agreement`."""
        key = self._prefix + "total " + name
        self.found[key] = own
        return self._known.get(key, own)

    @staticmethod
    def merged(found: list[dict[str, Any]]) -> dict[str, Any]:
        """What all shards need."""
        result = {}
        for key in dict.fromkeys(name for one in found for name in one):
            values = [one[key] for one in found if key in one]
            kind = key.rpartition(".")[2].partition(" ")[0]
            if kind == "union":
                result[key] = np.unique(np.concatenate(values))
            elif kind == "total":
                result[key] = sum(values[1:], values[0])
            else:
                result[key] = max(values)
        return result

    @staticmethod
    def same(one: dict[str, Any], other: dict[str, Any]) -> bool:
        """Whether two rounds found the same."""

        def equal(a: Any, b: Any) -> bool:
            if hasattr(a, "nnz"):
                return (a != b).nnz == 0
            return np.array_equal(a, b)

        return one.keys() == other.keys() and all(equal(one[key], other[key]) for key in one)
