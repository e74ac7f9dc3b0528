"""Which numbers are one unknown, and which are constant. Where all differ, or all are free, there
is nothing to do."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.typing import AnyArray, ArrayRecord, register_pytree


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Sharing(ArrayRecord):
    """The matrix T that copies unknowns to items, the rows of arrays: `d = T y`."""

    index: Int[AnyArray, " items"]  # the unknown of each item
    owners: Int[AnyArray, " owners"]  # unknowns of several items
    distinct: int = field(metadata={"static": True})  # number of unknowns
    several: bool = field(metadata={"static": True})  # whether any two items are one unknown

    @classmethod
    def of(cls, names: Int[np.ndarray, " items"]) -> Sharing:
        """Items of equal names are one unknown; unknowns are in the order of their first items.
        Items with negative names are not computed with, and own nothing."""
        unique, first, own, times = np.unique(
            names, return_index=True, return_inverse=True, return_counts=True
        )
        rank = np.argsort(np.argsort(first)).astype(np.int32)
        owners = np.sort(rank[(times > 1) & (unique >= 0)])
        return cls(rank[own], owners, len(first), len(first) < len(names))

    def with_room(self, owners: int, distinct: int) -> Sharing:
        """The same items, with room for more unknowns and owners, which have no items. Owners that
        are not there are out of range."""
        missing = np.full(owners - len(self.owners), distinct, np.int32)
        return replace(self, owners=np.append(self.owners, missing), distinct=distinct)

    @property
    def members(self) -> Bool[AnyArray, "items owners"]:
        """The columns of T of owners."""
        return self.index[:, None] == self.owners

    @property
    def is_shared(self) -> Bool[Array, " items"]:
        """Whether others are the same as an item."""
        return jnp.any(jnp.asarray(self.members), axis=1)

    def total(self, rows: Float[Array, "items ..."]) -> Float[Array, "distinct ..."]:
        """The product with `T^T`."""
        if not self.several:
            return rows
        return jax.ops.segment_sum(rows, jnp.asarray(self.index), num_segments=self.distinct)

    def copied(self, values: Float[Array, "distinct ..."]) -> Float[Array, "items ..."]:
        """The product with T."""
        return values[jnp.asarray(self.index)] if self.several else values

    def sums(self, rows: Float[Array, "items ..."]) -> Float[Array, "items ..."]:
        """For each item the sum over those that are the same."""
        return self.copied(self.total(rows))

    def shares(self, rows: Float[Array, "items ..."]) -> Float[Array, "items ..."]:
        """An equal part of the row of each item for each that is the same."""
        if not self.several:
            return rows
        return rows / self.sums(jnp.ones((len(rows), *[1] * (rows.ndim - 1)), rows.dtype))

    def mean(self, rows: Float[Array, "items ..."]) -> Float[Array, "items ..."]:
        """For each item the mean over those that are the same: the orthogonal projection on the
        range of T."""
        return self.shares(self.sums(rows))

    def merged(self, lower: Float[Array, "items items"]) -> Float[Array, "distinct distinct"]:
        """`T^T M T` of a symmetric M of which only the lower triangle is read. Unknowns without
        items have a unit row."""
        if not self.several:
            return lower
        matrix = jnp.tril(lower) + jnp.tril(lower, -1).T
        merged = self.total(self.total(matrix).T)
        items = self.total(jnp.ones(len(lower), lower.dtype))
        return merged + jnp.diag(jnp.where(items > 0, 0, 1).astype(lower.dtype))

    @staticmethod
    def joined(*parts: tuple[Sharing, int]) -> Sharing:
        """That of numbers of items, flattened: for each item those of the first part, then those of
        the next."""
        columns = []
        end = 0
        for part, size in parts:
            columns.append(end + jnp.asarray(part.index)[:, None] * size + jnp.arange(size))
            end += part.distinct * size
        index = jnp.concatenate(columns, axis=1).reshape(-1)
        return Sharing(index, np.zeros(0, np.int32), end, any(part.several for part, _ in parts))


@register_pytree
@dataclass(frozen=True, eq=False, repr=False)
class Mask(ArrayRecord):
    """Where something holds."""

    values: Bool[AnyArray, "..."]
    # whether it holds everywhere, so that there is nothing to do
    everywhere: bool = field(metadata={"static": True})

    @classmethod
    def of(cls, values: Bool[np.ndarray, "..."]) -> Mask:
        """With `everywhere` as the values say."""
        return cls(values, bool(values.all()))

    def where(self, new: Array, other: Array | float | int) -> Array:
        """The first where it holds, else the second."""
        return new if self.everywhere else jnp.where(self.values, new, other)

    def row(self, k: int) -> Mask:
        """That of a row."""
        return self if self.everywhere else Mask(self.values[k], False)

    def at_columns(self, index: Int[AnyArray, " n"]) -> Mask:
        """That of columns, in range."""
        if self.everywhere:
            return self
        return Mask(jnp.asarray(self.values).at[..., index].get(mode="promise_in_bounds"), False)
