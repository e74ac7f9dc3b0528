"""What the layouts of the shards of a problem must have in common: sizes of arrays, and lists of blocks."""

from __future__ import annotations

from typing import Any

import numpy as np


class Agreement:
    """Sizes that the layouts of all shards must share, found by repeated rounds.

    A layout asks for a size, a list of keys or a sum by name, and gives its own. It gets that of all shards from the
    round before, or its own in the first one.
    """

    def __init__(self, known: dict[str, Any], found: dict[str, Any] | None = None, prefix: str = "") -> None:
        self._known = known
        self._prefix = prefix
        self.found: dict[str, Any] = {} if found is None else found

    def within(self, name: str) -> Agreement:
        """The same for a part, whose names begin with that of the part."""
        return Agreement(self._known, self.found, f"{self._prefix}{name}.")

    def size(self, name: str, own: int) -> int:
        """The largest of a number in all shards."""
        self.found[self._prefix + name] = own
        return max(own, self._known.get(self._prefix + name, own))

    def union(self, name: str, own: np.ndarray) -> np.ndarray:
        """The sorted union of keys in all shards."""
        key = self._prefix + "union " + name
        self.found[key] = own
        return np.union1d(own, self._known.get(key, own))

    def total(self, name: str, own: Any) -> Any:
        """The sum over all shards of an array or a sparse matrix."""
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


def size_of(agreement: Agreement | None, name: str, own: int) -> int:
    """`Agreement.size`, or the own number if there is only one shard."""
    return own if agreement is None else agreement.size(name, own)
