"""The two axis orders of arrays, and the functions that convert between them.

The state, the camera model and all arrays over observations are components-first: cameras are `[9, cameras]`, points
`[3, points]`, so that every component is a contiguous vector. Linear algebra is items-first: steps, gradients and
right-hand sides of the reduced camera system are `[cameras, 9]`, its blocks `[cameras, 9, 9]`. The arrays of a
`BundleProblem` are items-first, too.
"""

from __future__ import annotations

from typing import TypeVar

import numpy as np
from jax import Array

AnArray = TypeVar("AnArray", np.ndarray, Array)


def components_first(items: AnArray) -> AnArray:
    """`[items, components]` to `[components, items]`."""
    return items.T


def items_first(components: AnArray) -> AnArray:
    """`[components, items]` to `[items, components]`."""
    return components.T
