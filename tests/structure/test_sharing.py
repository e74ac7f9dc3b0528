"""Numbers that are one unknown: all that is done with them is that of the matrix which copies
unknowns to items."""

from __future__ import annotations

import jax.numpy as jnp
import numpy as np
import pytest

from jaxba.structure.sharing import Mask, Sharing

NAMES = np.array([7, 2, 7, 5, 2, 9, 7])
RNG = np.random.default_rng(0)


def copy_matrix(sharing: Sharing) -> np.ndarray:
    """T, from the index."""
    return np.eye(sharing.distinct)[np.asarray(sharing.index)]


def flat() -> tuple[Sharing, np.ndarray]:
    """Two numbers of items that differ, then three of the items of `NAMES`, and names of all of
    them."""
    apart = Sharing.of(np.arange(len(NAMES)))
    named = Sharing.of(NAMES)
    rows = [
        [*(f"of item {item}: {k}" for k in range(2)), *(f"of name {name}: {k}" for k in range(3))]
        for item, name in enumerate(NAMES)
    ]
    return Sharing.joined((apart, 2), (named, 3)), np.array(rows).ravel()


def test_items_of_equal_names_are_one_unknown():
    sharing = Sharing.of(NAMES)
    same = sharing.index[:, None] == sharing.index
    np.testing.assert_array_equal(same, NAMES[:, None] == NAMES)
    assert sharing.distinct == 4
    np.testing.assert_array_equal(sharing.is_shared, np.isin(NAMES, [7, 2]))
    joined, names = flat()
    index = np.asarray(joined.index)
    np.testing.assert_array_equal(index[:, None] == index, names[:, None] == names)
    assert joined.distinct == index.max() + 1


@pytest.mark.parametrize("sharing", [Sharing.of(NAMES), Sharing.of(np.arange(7)), flat()[0]])
def test_products_are_those_of_the_matrix_of_copies(sharing):
    copies = copy_matrix(sharing)
    items, unknowns = copies.shape
    rows = jnp.asarray(RNG.normal(size=(items, 3)))
    values = jnp.asarray(RNG.normal(size=(unknowns, 3)))
    matrix = RNG.normal(size=(items, items))
    matrix = matrix + matrix.T

    def near(found, wanted):
        return np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-13)

    near(sharing.total(rows), copies.T @ rows)
    near(sharing.copied(values), copies @ values)
    near(sharing.sums(rows), copies @ copies.T @ rows)
    near(sharing.mean(rows), copies @ np.linalg.pinv(copies) @ rows)
    near(
        sharing.copied(sharing.total(sharing.shares(sharing.copied(values)))),
        sharing.copied(values),
    )
    near(np.tril(sharing.merged(jnp.asarray(np.tril(matrix)))), np.tril(copies.T @ matrix @ copies))


def test_what_differs_or_is_free_everywhere_is_left_alone():
    apart = Sharing.of(np.arange(7))
    rows = jnp.ones((7, 7))
    assert all(
        function(rows) is rows for function in (apart.sums, apart.mean, apart.shares, apart.merged)
    )
    assert Mask.of(np.ones(7, bool)).where(rows, 0) is rows
    some = Mask.of(NAMES == 7)
    np.testing.assert_array_equal(some.where(rows, 0), np.where(NAMES == 7, np.ones((7, 7)), 0))
    np.testing.assert_array_equal(some.at_columns(np.array([1, 2])).values, [False, True])
