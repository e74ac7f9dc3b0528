"""Array aliases and limits that every room may use."""

from __future__ import annotations

import numpy as np
from jax import Array

AnyArray = np.ndarray | Array
"""An array on the host or on a device; tracers are of the second kind."""

LARGEST_COUNT = 2**31 - 1
"""Largest count that an option may have: programs count in 32 bits."""
