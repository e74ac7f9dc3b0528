"""The look-ahead oracle, on a tree of costs that is small enough to look at whole."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from benchmarks.oracle import beam_search
from jaxba.lm.records import LMState

pytestmark = pytest.mark.slow

GRID = (1e-3, 1e-2, 1e-1)
DEPTH = 4


class Info(NamedTuple):
    """What the search looks at."""

    accepted: jax.Array


def tree(seed: int) -> np.ndarray:
    """Cost of each node; the children of node n are 3 n + 1 to 3 n + 3. Some are twins, a tenth are above the root."""
    rng = np.random.default_rng(seed)
    count = sum(len(GRID) ** depth for depth in range(DEPTH + 1))
    costs = np.round(rng.uniform(0, 1, count), 2)
    costs[rng.random(count) < 0.1] = 20.0
    costs[0] = 10.0
    return costs


def search(costs: np.ndarray, width: int) -> list[float]:
    """The oracle on the tree; a step that would raise the cost is rejected and leaves the state."""

    def step(state: LMState, damping: jax.Array) -> tuple[LMState, Info]:
        place = jnp.argmin(jnp.abs(jnp.log(jnp.asarray(GRID)) - jnp.log(damping)))
        child = (3 * state.cameras[0, 0] + 1 + place).astype(jnp.int32)
        cost = jnp.asarray(costs)[child]
        accepted = cost < state.cost
        moved = LMState(jnp.full((1, 9), child, float), state.points, cost)
        return jax.tree.map(lambda new, old: jnp.where(accepted, new, old), moved, state), Info(accepted)

    start = LMState(jnp.zeros((1, 9)), jnp.zeros((1, 3)), jnp.asarray(costs[0]))
    return np.asarray(beam_search(step, start, DEPTH, width, GRID)).tolist()


def by_hand(costs: np.ndarray, width: int) -> list[float]:
    """A beam search in Python: the parents stay in the race, and twins come last, where there is room."""
    beam, found = [0], [costs[0]]
    for _ in range(DEPTH):
        children = [3 * node + k for node in beam for k in (1, 2, 3) if costs[3 * node + k] < costs[node]]
        first, twins, seen = [], [], set()
        for node in sorted([*children, *beam], key=lambda node: costs[node]):
            (twins if costs[node] in seen else first).append(node)
            seen.add(costs[node])
        beam = (first + twins)[:width]
        found.append(costs[beam[0]])
    return found


@pytest.mark.parametrize("width", [1, 2, 4])
def test_the_beam_is_that_of_a_search_by_hand(width):
    for seed in range(10):
        assert search(tree(seed), width) == by_hand(tree(seed), width)


def test_a_wide_beam_finds_the_lowest_cost_that_any_line_of_lambdas_reaches():
    for seed in range(10):
        costs = tree(seed)
        lowest, reached = costs[0], [0]
        for _ in range(DEPTH):
            reached = [3 * node + k for node in reached for k in (1, 2, 3) if costs[3 * node + k] < costs[node]]
            lowest = min([lowest, *costs[reached]])
        assert search(costs, 200)[-1] == lowest


def test_the_greedy_choice_loses_somewhere():
    ends = np.array([[search(tree(seed), width)[-1] for width in (1, 4)] for seed in range(20)])
    assert (ends[:, 0] >= ends[:, 1]).all()
    assert (ends[:, 0] > ends[:, 1]).any()
