"""Iterations of policies, rules and the look-ahead oracle on the held-out scenes of a training run.

    python -m benchmarks.game runs/default --policy learned --policy learned+refine0 --scenes 200

The rules, a grid of constant lambdas, random lambdas, the virtual best of the rules and constants, and the oracle (beam
search and greedy search over lambda) are run with plain steps, with three point iterations, and with all embedded
iterations. Learned policies are run with the step that they were trained with. With several `--policy`, the first is
compared with each of the others scene by scene.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np

from benchmarks.oracle import WIDTH, oracle
from jaxba.cli.common import prepare_process
from jaxba.damping import DampingPolicy, Schedule, make_policy
from jaxba.damping.agent_config import AgentConfig
from jaxba.game.evaluate import Score, score, virtual_best
from jaxba.game.rollout import Trajectories, play
from jaxba.game.scene_bank import reach, select
from jaxba.problem.options import Refinement, StepOptions
from jaxba.runtime import process
from jaxba.solver.names import parse_solver
from jaxba.training.config import load
from jaxba.training.task import BANK, read_banks

RULES = ("classic", "ceres", "gtsam", "nielsen", "theseus", "gauss-newton", "schedule")
CONSTANTS = tuple(f"constant:1e{decade}" for decade in (-8, -6, -5, -4, -3, -2))
LIMIT = 40
"""Limit of linear solves of a scene."""

STEPS = {
    "": StepOptions(),
    "+refine3": StepOptions(refinement=Refinement(points=3)),
    "+embedded": AgentConfig().step_options(StepOptions()),
}
"""Steps by the suffix of their name: plain, with point iterations, with all embedded iterations."""


def main() -> None:
    """Prints a Markdown table for each tolerance."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of jaxba-train")
    parser.add_argument("--policy", action="append", default=[], help="learned solver, or file; may be repeated")
    parser.add_argument("--scenes", type=int, default=200, help="number of held-out scenes of each class")
    parser.add_argument("--oracle", type=int, default=48, help="number of scenes for the oracle; 0: none")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    prepare_process()
    config = load(str(args.run / "config.yaml"))
    splits = read_banks(args.run / BANK)
    with process.single_blas_thread():
        for kind, split in zip(config.bank.classes, splits, strict=True):
            count = min(args.scenes, len(split.held_out.initial_cost))
            bank = select(split.held_out, np.arange(count))
            runs = _runs(kind, bank, args.policy)
            some = select(bank, np.arange(min(args.oracle, count)))
            beams = {}
            for suffix, options in STEPS.items() if args.oracle else ():
                for name, width in ((f"beam search, width {WIDTH}", WIDTH), ("greedy", 1)):
                    beams[name + suffix] = oracle(kind, some, options, LIMIT, width=width)
                    print(f"played {name}{suffix}", flush=True)
            _report(bank, runs, beams, args.policy)


def _runs(kind, bank, policies: list[str]) -> dict[str, Trajectories]:
    numbers = 10 ** np.random.default_rng(0).uniform(-8, 2, 100)
    named: dict[str, DampingPolicy] = {name: make_policy(name) for name in (*RULES, *CONSTANTS)}
    named["random"] = Schedule(values=tuple(numbers))
    runs = {}
    for suffix, options in STEPS.items():
        for name, policy in named.items():
            runs[name + suffix] = play(kind, bank, policy, options, LIMIT)
            print(f"played {name}{suffix}", flush=True)
    for name in policies:
        runs[name] = _play_solver(kind, bank, name)
    return runs


def _play_solver(kind, bank, name: str) -> Trajectories:
    policy, options = parse_solver(name).build()
    return play(kind, bank, policy, options.step_options(policy), LIMIT)


def _report(bank, runs: dict[str, Trajectories], beams: dict[str, Trajectories], policies: list[str]) -> None:
    best = np.min([np.asarray(bank.best_cost), *(run.costs[:, -1] for run in runs.values())], axis=0)
    for name, beam in beams.items():
        best[: len(beam.costs)] = np.minimum(best[: len(beam.costs)], beam.costs[:, -1])
        print(f"{name}: {len(beam.costs)} scenes")
    for tolerance in (1e-3, 1e-4):
        print(f"\nwithin {tolerance:g} of the best known cost, {len(best)} scenes, at most {LIMIT} iterations\n")
        print("| policy | mean | geometric mean | median | 90% | never | to convergence |")
        print("| --- | --: | --: | --: | --: | --: | --: |")
        rows = {name: score([run], [best], tolerance, LIMIT) for name, run in runs.items()}
        for suffix in STEPS:
            lowest = virtual_best([runs[name + suffix] for name in (*RULES, *CONSTANTS)], LIMIT)
            rows[f"virtual best{suffix}"] = score([lowest], [best], tolerance, LIMIT)
        for name, beam in beams.items():
            size = len(beam.costs)
            rows[f"{name} ({size} scenes)"] = score([beam], [best[:size]], tolerance, LIMIT)
            for other, run in runs.items():
                if other in policies:
                    few = Trajectories(*(field[:size] for field in run))
                    rows[f"{other} ({size} scenes)"] = score([few], [best[:size]], tolerance, LIMIT)
        for name, row in rows.items():
            print(_row(name, row))
        for other in policies[1:]:
            print(f"\n{policies[0]} less {other}, scene by scene, mean ± 1.96 standard errors:")
            counts = [_counts(runs[name], best, tolerance) for name in (policies[0], other)]
            for goal, first, second in zip(("tolerance", "convergence"), *counts, strict=True):
                print(f"to {goal} {_paired(first - second)}")


def _counts(run: Trajectories, best: np.ndarray, tolerance: float) -> tuple[np.ndarray, np.ndarray]:
    """Iterations of each scene to the tolerance and to convergence, counted as in `score`."""
    reached = np.clip(reach(run.costs, best, tolerance), 1, LIMIT)
    return reached, np.where(run.converged, run.iterations, LIMIT)


def _paired(difference: np.ndarray) -> str:
    """Mean of the differences, with its 95% interval."""
    error = difference.std(ddof=1) / np.sqrt(len(difference))
    return f"{difference.mean():+.2f} ± {1.96 * error:.2f}"


def _row(name: str, s: Score) -> str:
    numbers = f"{s.mean:.2f} | {s.geometric_mean:.2f} | {s.median:g} | {s.p90:g} | {s.failures:.1%}"
    return f"| {name} | {numbers} | {s.to_convergence:.2f} |"


if __name__ == "__main__":
    main()
