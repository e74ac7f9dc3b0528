"""The best constant action of a game: what an agent must beat to have learned something."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.learned import ConstantAction
from jaxba.game.evaluate import evaluate
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import Bank, select
from jaxba.problem.options import StepOptions

LAMBDAS = np.linspace(-1.0, 1.0, 12)
"""Values of the first number of an action that are tried: a decade apart in the default range of lambda."""

ROUNDS = 2
"""Times that every number of the action is optimised, the others fixed."""

SCENES = 512
"""Scenes of each bank on which actions are compared."""


def best_constant_action(
    kinds: Sequence[SceneClass],
    banks: Sequence[Bank],
    config: AgentConfig,
    options: StepOptions,
    tolerance: float = 1e-3,
    limit: int = 40,
    report: Callable[[str], None] = lambda _: None,
) -> ConstantAction:
    """The constant action with the lowest mean price on the banks, found by coordinate search: each number goes up or
    down as long as that pays.

    Args:
        kinds: classes of the banks.
        banks: scenes to search on, those of training.
        config: what an action means, and the guard.
        options: of the agent's step.
        tolerance: of the cost, relative to the best known.
        limit: largest number of iterations.
        report: called with a line of text for every action that is tried.
    """
    few = [select(bank, np.arange(min(SCENES, len(bank.initial_cost)))) for bank in banks]
    tried: dict[tuple[float, ...], float] = {}

    def price(action: tuple[float, ...]) -> float:
        if action not in tried:
            tried[action] = evaluate(kinds, few, ConstantAction(action, config), options, tolerance, limit).price
            report(f"constant action {', '.join(f'{x:.2f}' for x in action)}: price {tried[action]:.3f}")
        return tried[action]

    values = values_of(config)
    at = [len(LAMBDAS) // 2, *(len(choices) - 1 for choices in values[1:])]
    action_at = lambda at: tuple(float(choices[k]) for choices, k in zip(values, at, strict=True))
    for _ in range(ROUNDS):
        for place, choices in enumerate(values):
            for direction in (-1, 1):
                while 0 <= at[place] + direction < len(choices):
                    moved = [*at[:place], at[place] + direction, *at[place + 1 :]]
                    if price(action_at(moved)) >= price(action_at(at)):
                        break
                    at = moved
    return ConstantAction(action_at(at), config)


def values_of(config: AgentConfig) -> list[np.ndarray]:
    """Values of each number of an action that make a difference."""
    if config.effort == "fixed":
        return [LAMBDAS]
    return [LAMBDAS, np.linspace(-1.0, 1.0, config.refine_points + 1), np.array([-1.0, 1.0])]
