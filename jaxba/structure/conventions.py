"""The two conventions of arrays, and the only functions that lead from one to the other.

State, camera model and everything that runs over observations keep the components first: cameras are `[9, cameras]`,
points `[3, points]`, so that every component is one contiguous vector. Linear algebra keeps the items first: steps,
gradients and right-hand sides of the reduced camera system are `[cameras, 9]`, blocks `[cameras, 9, 9]`, and so are the
arrays of a `BundleProblem`.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from jax import Array

AnArray = TypeVar("AnArray", np.ndarray, Array)


def components_first(items: AnArray) -> AnArray:
    """`[items, components]` as `[components, items]`."""
    return items.T


def items_first(components: AnArray) -> AnArray:
    """`[components, items]` as `[items, components]`."""
    return components.T
