"""Scores of policies on a bank of scenes: iterations, failures and final costs."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.damping import DampingPolicy
from jaxba.damping.learned import always
from jaxba.game.env import GameConfig
from jaxba.game.random_scenes import SceneClass
from jaxba.game.rollout import Trajectories, alike, play
from jaxba.game.scene_bank import Bank, reach
from jaxba.game.statistics import capped, geometric_mean
from jaxba.problem.options import StepOptions


class Score(NamedTuple):
    """Iterations to within a tolerance of the best known cost; a failure counts as the limit."""

    mean: float
    geometric_mean: float
    median: float
    p90: float
    failures: float
    """Fraction of the scenes that never reach the tolerance."""

    to_convergence: float
    """Mean iterations until the solver's own convergence test, the limit if it never holds."""

    end: float
    """Median of the final cost over the best known, less one."""


def score(
    run: Trajectories, best: Float[np.ndarray, " scenes"], tolerance: float, limit: int
) -> Score:
    """The score of a policy's run on a bank, whose best known costs are given."""
    iterations = iterations_to(run, best, tolerance)
    counted = capped(iterations, limit)
    return Score(
        mean=float(counted.mean()),
        geometric_mean=geometric_mean(counted),
        median=float(np.median(counted)),
        p90=float(np.percentile(counted, 90)),
        failures=float(np.mean(~(iterations <= limit))),
        to_convergence=float(np.where(run.converged, run.iterations, limit).mean()),
        end=float(np.median(run.costs[:, -1] / best - 1)),
    )


def iterations_to(
    run: Trajectories, best: Float[np.ndarray, " scenes"], tolerance: float
) -> Float[np.ndarray, " scenes"]:
    """Iterations to within a tolerance of every scene's best cost, at least 1; infinite for a
    failure."""
    return np.maximum(reach(run.costs, best, tolerance), 1)


def evaluate(
    kind: SceneClass,
    bank: Bank,
    policy: DampingPolicy,
    options: StepOptions,
    tolerance: float = 1e-3,
    limit: int = 40,
) -> Score:
    """A policy's score on all scenes, in at most `limit` linear solves; `tolerance` is relative to
    the best cost."""
    return score(
        play(kind, bank, policy, options, limit), np.asarray(bank.best_cost), tolerance, limit
    )


CONSTANT_ACTIONS = tuple(float(x) for x in np.linspace(-1.0, 1.0, 12))
"""Actions of which `best_constant_action` takes the best: a decade apart in the default range of
lambda."""


def best_constant_action(
    kind: SceneClass,
    bank: Bank,
    rules: GameConfig,
    options: StepOptions,
    beside: Mapping[str, tuple[DampingPolicy, StepOptions]] | None = None,
) -> float:
    """The constant action with the fewest mean iterations: what an agent must beat to have learned
    something. The bank is that of training; `beside` are policies that are played, too, so that all
    share programs."""
    tried = {str(action): action for action in CONSTANT_ACTIONS}
    own = {name: (always(action, rules.agent), options) for name, action in tried.items()}
    steps = alike({**(beside or {}), **own})

    def mean(name):
        return evaluate(kind, bank, *steps[name], rules.tolerance, rules.max_iterations).mean

    return tried[min(tried, key=mean)]


def play_all(
    kind: SceneClass,
    bank: Bank,
    policies: Mapping[str, tuple[DampingPolicy, StepOptions]],
    limit: int = 40,
) -> dict[str, Trajectories]:
    """Trajectories of every policy on every scene, by the policy's name. Those with equal steps
    share programs."""
    return {name: play(kind, bank, *one, limit) for name, one in alike(policies).items()}


def best_costs(runs: Mapping[str, Trajectories], bank: Bank) -> Float[np.ndarray, " scenes"]:
    """The lowest cost of each scene in the bank and in all runs."""
    return np.min(
        [np.asarray(bank.best_cost), *(run.costs[:, -1] for run in runs.values())], axis=0
    )


def scores(
    policies: Mapping[str, Trajectories],
    rules: Mapping[str, Trajectories],
    bank: Bank,
    tolerance: float,
    limit: int,
) -> dict[str, Score]:
    """Scores of all policies and rules, and as `virtual best` that of the best rule for each scene:
    the lowest cost after each iteration, and the fewest iterations to convergence, each of the rule
    that has it.

    The best cost of a scene is the lowest one of the bank and of all these runs, the same for all
    scores."""
    runs = {**policies, **rules}
    every = rules.values()
    lowest = Trajectories(
        costs=np.min([run.costs for run in every], axis=0),
        dampings=next(iter(every)).dampings,
        iterations=np.min(
            [np.where(run.converged, run.iterations, limit) for run in every], axis=0
        ),
        converged=np.any([run.converged for run in every], axis=0),
    )
    best = best_costs(runs, bank)
    return {
        name: score(run, best, tolerance, limit)
        for name, run in {**runs, "virtual best": lowest}.items()
    }
