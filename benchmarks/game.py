"""Policies, rules and the look-ahead oracle on the held-out scenes of a training run.

    python -m benchmarks.game runs/default --policy learned --policy learned+refine0 --scenes 200

Every rule, every constant of a grid, a random policy, the virtual best of these per scene, beam search over lambda and
its greedy cousin, each with plain steps, with three point iterations, and with all embedded iterations; and learned
policies, each with its own step.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import jax
import numpy as np

from jaxba.cli.common import prepare_process
from jaxba.damping import DampingPolicy, Schedule, make_policy
from jaxba.damping.agent_config import AgentConfig
from jaxba.game.evaluate import Score, score
from jaxba.game.oracle import WIDTH, oracle
from jaxba.game.rollout import Trajectories, play
from jaxba.game.scene_bank import sieve
from jaxba.problem.options import Refinement, StepOptions
from jaxba.runtime import process
from jaxba.solver.names import parse_solver
from jaxba.training.config import load
from jaxba.training.task import BANK, read_banks

RULES = ("classic", "ceres", "gtsam", "nielsen", "theseus", "gauss-newton", "schedule")
CONSTANTS = tuple(f"constant:1e{decade}" for decade in (-8, -6, -5, -4, -3, -2))
LIMIT = 40
STEPS = {
    "": StepOptions(),
    "+refine3": StepOptions(refinement=Refinement(points=3)),
    "+embedded": AgentConfig().step_options(StepOptions()),
}
"""Plain, with point iterations, and with all embedded ones."""


def main() -> None:
    """Prints a Markdown table per tolerance."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="folder of jaxba-train")
    parser.add_argument("--policy", action="append", default=[], help="learned solver, or file; may be repeated")
    parser.add_argument("--scenes", type=int, default=200, help="held-out scenes of each class")
    parser.add_argument("--oracle", type=int, default=48, help="scenes of them that the oracle plays; 0: none")
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    prepare_process()
    config = load(str(args.run / "config.yaml"))
    splits = read_banks(args.run / BANK)
    with process.single_blas_thread():
        for kind, split in zip(config.bank.classes, splits, strict=True):
            count = min(args.scenes, len(split.held_out.initial_cost))
            bank = sieve(split.held_out, np.arange(count))
            runs = _runs(kind, bank, args.policy)
            some = sieve(bank, np.arange(min(args.oracle, count)))
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
        runs[name] = _played(kind, bank, name)
    return runs


def _played(kind, bank, name: str) -> Trajectories:
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
            members = [runs[n + suffix] for n in (*RULES, *CONSTANTS)]
            lowest = members[0]._replace(
                costs=np.min([m.costs for m in members], axis=0),
                iterations=np.min([np.where(m.converged, m.iterations, LIMIT) for m in members], axis=0),
                converged=np.any([m.converged for m in members], axis=0),
            )
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


def _row(name: str, s: Score) -> str:
    numbers = f"{s.mean:.2f} | {s.geometric_mean:.2f} | {s.median:.0f} | {s.p90:.0f} | {s.failures:.1%}"
    return f"| {name} | {numbers} | {s.to_convergence:.1f} |"


if __name__ == "__main__":
    main()
