"""Statistics of solvers or policies on problems, for games, trainings, benchmarks and the paper.

Pure functions of arrays with an entry per problem or scene. Iterations and seconds to a target are
infinite if it is never reached. Ratios are ours / theirs, so that below 1 is better."""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

# least seconds in geometric means of times, which are 0 where the start satisfies a target
SHORTEST_TIME = 1e-6
# bootstrap samples; a bound of an interval moves by a fiftieth of its width between two sets
RESAMPLES = 2000


class Reached(NamedTuple):
    """Linear solves and seconds, without compilation, that a solver needed to a target: on one
    problem, or arrays of all. Infinite if it never reached it, 0 if the start satisfies it."""

    iterations: Any
    seconds: Any


def capped(iterations: Float[np.ndarray, " *shape"], limit: int) -> Float[np.ndarray, " *shape"]:
    """Iterations to a target where a failure counts as the limit, and a target reached at the start
    as one."""
    return np.clip(iterations, 1.0, limit)


def geometric_mean(values: Iterable[Any], floor: float = 0.0) -> float:
    """exp(mean(log)); values below `floor` count as `floor`, a zero makes it 0, infinity infinite,
    none NaN."""
    given = values if isinstance(values, np.ndarray) else np.fromiter(values, float)
    raised = np.maximum(given, floor)
    if not raised.size or (raised == 0).any():
        return 0.0 if raised.size else math.nan
    return float(np.exp(np.log(raised).mean()))


def paired_ratio(
    ours: Float[np.ndarray, " cases"], theirs: Float[np.ndarray, " cases"]
) -> tuple[float, float, float]:
    """Geometric mean of `ours / theirs` over cases that both had, and the ends of the 95%
    percentile interval of a bootstrap over the cases. Source: Efron and Tibshirani 1993, "An
    Introduction to the Bootstrap", section 13.3."""
    logs = np.log(np.asarray(ours) / np.asarray(theirs))
    rows = np.random.default_rng(0).integers(len(logs), size=(RESAMPLES, len(logs)))
    low, high = np.percentile(logs[rows].mean(axis=1), [2.5, 97.5])
    return float(np.exp(logs.mean())), float(np.exp(low)), float(np.exp(high))
