"""Dataclasses as pytrees: rebuilt from anything, while types are checked where people call."""

from __future__ import annotations

import dataclasses

import jax
import jaxtyping
import numpy as np
import pytest
import support

from jaxba import BundleProblem, Ceres, Lenses, build_layout
from jaxba.typing import register_pytree


@register_pytree
@dataclasses.dataclass(frozen=True)
class Pair:
    left: object
    right: object
    name: str = dataclasses.field(default="pair", metadata={"static": True})

    def __post_init__(self) -> None:
        if isinstance(self.left, str):
            raise ValueError("left is a name")


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class PairOfJax:
    left: object
    right: object
    name: str = dataclasses.field(default="pair", metadata={"static": True})


@pytest.mark.parametrize("pair", [Pair(1, (2, 3)), Pair(None, 2, "other")])
def test_leaves_and_their_paths_are_those_of_jaxs_own_registration(pair):
    theirs = PairOfJax(pair.left, pair.right, pair.name)
    assert jax.tree_util.tree_leaves_with_path(pair) == jax.tree_util.tree_leaves_with_path(theirs)
    assert jax.tree.unflatten(jax.tree.structure(pair), jax.tree.leaves(pair)) == pair


def test_static_fields_are_part_of_the_structure():
    assert jax.tree.structure(Pair(1, 2)) == jax.tree.structure(Pair(3, 4))
    assert jax.tree.structure(Pair(1, 2)) != jax.tree.structure(Pair(1, 2, "other"))


def test_classes_with_equal_fields_are_different_structures():
    @register_pytree
    @dataclasses.dataclass(frozen=True)
    class Other(Pair):
        pass

    assert jax.tree.structure(Pair(1, 2)) != jax.tree.structure(Other(1, 2))


def test_a_tree_is_rebuilt_without_the_checks_of_its_constructor():
    assert jax.tree.map(str, Pair(1, 2)).left == "1"
    with pytest.raises(ValueError, match="left is a name"):
        Pair("1", 2)


@pytest.mark.parametrize(
    "make", [lambda: build_layout(support.tiny()), support.tiny, Ceres], ids=["layout", "", "rule"]
)
def test_trees_hold_whatever_jax_puts_in_the_place_of_arrays(make):
    tree = make()
    assert type(jax.tree.map(lambda _: None, tree)) is type(tree)
    shapes = jax.eval_shape(
        lambda tree: jax.tree.map(lambda x: x[None], jax.tree.map(jax.numpy.asarray, tree)), tree
    )
    assert {leaf.shape[0] for leaf in jax.tree.leaves(shapes)} == {1}


def test_types_are_checked_where_people_call():
    with pytest.raises(jaxtyping.TypeCheckError):
        BundleProblem(
            np.zeros((1, 9)), np.zeros((1, 2)), np.zeros((1, 2)), np.zeros(1, int), np.zeros(1, int)
        )
    with pytest.raises(jaxtyping.TypeCheckError):
        Lenses(np.zeros(3, int), np.ones((1, 3), int))
