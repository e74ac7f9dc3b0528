"""Scores of policies on a bank of scenes: iterations, failures and final costs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from jaxba.damping import DampingPolicy
from jaxba.game.random_scenes import SceneClass
from jaxba.game.rollout import Trajectories, play
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

    price: float
    """Geometric mean of the price of the iterations to within the tolerance (`Prices`); a failure costs as many plain
    steps as the limit has, or what was paid if that is more."""


def score(runs: Sequence[Trajectories], best: Sequence[Float[np.ndarray, " _"]], tolerance: float, limit: int) -> Score:
    """The score of a policy's runs on several banks; every scene has the same weight."""
    by_bank = [reach(run.costs, b, tolerance) for run, b in zip(runs, best, strict=True)]
    iterations = np.concatenate(by_bank)
    counted = amounts(runs, best, tolerance, limit, priced=False)
    ends = np.concatenate([run.costs[:, -1] / b - 1 for run, b in zip(runs, best, strict=True)])
    paid = amounts(runs, best, tolerance, limit, priced=True)
    length = np.concatenate([np.where(run.converged, run.iterations, limit) for run in runs])
    return Score(
        mean=float(counted.mean()),
        geometric_mean=geometric_mean(counted),
        median=float(np.median(counted)),
        p90=float(np.percentile(counted, 90)),
        failures=float(np.mean(~(iterations <= limit))),
        to_convergence=float(length.mean()),
        end=float(np.median(ends)),
        price=geometric_mean(paid),
    )


def prices_to(run: Trajectories, iterations: Float[np.ndarray, " scenes"], limit: int) -> Float[np.ndarray, " scenes"]:
    """Price of each scene's iterations to a tolerance, see `Score.price`.

    Args:
        run: trajectories of a policy.
        iterations: iterations to the tolerance, as `scene_bank.reach` returns them.
        limit: largest number of iterations.
    """
    at = np.clip(np.maximum(iterations, 1), 1, limit).astype(int)
    paid = np.take_along_axis(run.paid, at[:, None], axis=1)[:, 0]
    return np.where(iterations <= limit, paid, np.maximum(run.paid[:, -1], limit))


def amounts(
    runs: Sequence[Trajectories], best: Sequence[Float[np.ndarray, " _"]], tolerance: float, limit: int, priced: bool
) -> np.ndarray:
    """Of every scene of several banks the price (`Score.price`) or, if not `priced`, the iterations to within the
    tolerance. Other arguments as for `score`."""
    reached = [reach(run.costs, b, tolerance) for run, b in zip(runs, best, strict=True)]
    if not priced:
        return capped(np.concatenate(reached), limit)
    return np.concatenate([prices_to(run, found, limit) for run, found in zip(runs, reached, strict=True)])


def evaluate(
    kinds: Sequence[SceneClass],
    banks: Sequence[Bank],
    policy: DampingPolicy,
    options: StepOptions,
    tolerance: float = 1e-3,
    limit: int = 40,
) -> Score:
    """Plays a policy on every scene of the banks.

    Args:
        kinds: classes of the banks.
        banks: scenes.
        policy: chooses lambda.
        options: of the step.
        tolerance: relative to the best known cost.
        limit: largest number of linear solves of a scene.
    """
    runs = [play(kind, bank, policy, options, limit) for kind, bank in zip(kinds, banks, strict=True)]
    return score(runs, [np.asarray(bank.best_cost) for bank in banks], tolerance, limit)


Runs = list[Trajectories]
"""Trajectories of one policy on each bank."""


def play_all(
    kinds: Sequence[SceneClass],
    banks: Sequence[Bank],
    policies: Mapping[str, tuple[DampingPolicy, StepOptions]],
    limit: int = 40,
) -> dict[str, Runs]:
    """Trajectories of every policy on every scene, by the policy's name."""
    return {
        name: [play(kind, bank, policy, options, limit) for kind, bank in zip(kinds, banks, strict=True)]
        for name, (policy, options) in policies.items()
    }


def virtual_best(runs: Sequence[Trajectories], limit: int) -> Trajectories:
    """The virtual best of several policies on a bank: for each scene the lowest cost after each iteration, and the
    fewest iterations to convergence, each of the policy that has it. Its dampings are those of the first policy."""
    return Trajectories(
        costs=np.min([run.costs for run in runs], axis=0),
        dampings=runs[0].dampings,
        iterations=np.min([np.where(run.converged, run.iterations, limit) for run in runs], axis=0),
        converged=np.any([run.converged for run in runs], axis=0),
        paid=np.min([run.paid for run in runs], axis=0),
    )


def best_costs(runs: Mapping[str, Runs], banks: Sequence[Bank]) -> list[np.ndarray]:
    """The lowest cost of each scene in the bank and in all runs."""
    return [
        np.min([np.asarray(bank.best_cost), *(run[k].costs[:, -1] for run in runs.values())], axis=0)
        for k, bank in enumerate(banks)
    ]


def scores(
    policies: Mapping[str, Runs], rules: Mapping[str, Runs], banks: Sequence[Bank], tolerance: float, limit: int
) -> dict[str, Score]:
    """Scores of all policies and rules, and as `virtual best` that of the best rule for each scene.

    The best cost of a scene is the lowest one of the bank and of all these runs, the same for all scores.
    """
    runs = {**policies, **rules}
    best = best_costs(runs, banks)
    lowest = [virtual_best([run[k] for run in rules.values()], limit) for k in range(len(banks))]
    return {name: score(run, best, tolerance, limit) for name, run in {**runs, "virtual best": lowest}.items()}
