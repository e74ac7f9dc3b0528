"""How far a game could be won: the look-ahead with rollouts beside the best constant action and a trained policy.

    python -m benchmarks.look_ahead RUN [--scenes 64]

RUN is a folder of `jaxba-train`. The best constant action is searched on its training scenes. The first of its held-out
scenes are then played by that action, by the trained policy, and by a look-ahead (jaxba/game/look_ahead.py) with either
as its base; from every state the look-ahead tries a grid of lambdas. Printed are geometric means of the iterations, and
their paired ratios to the constant action's with 95% intervals.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import jax
import numpy as np
import tyro

from jaxba.cli.common import prepare_process
from jaxba.damping.policy_file import load_policy
from jaxba.game.env import make_game
from jaxba.game.evaluate import best_constant_action, paired_ratio
from jaxba.game.look_ahead import look_ahead
from jaxba.game.scene_bank import select
from jaxba.runtime import process
from jaxba.training.config import load
from jaxba.training.task import BANK, first_scenes, read_banks

LAMBDAS = (-1.0, -0.6, -0.2, 0.2, 0.6)
"""Actions that are tried."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the training."""

    scenes: int = 64
    """Held-out scenes of each class."""


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark."""
    args = tyro.cli(Arguments, args=argv)
    jax.config.update("jax_enable_x64", True)
    prepare_process()
    config, splits = load(str(args.run / "config.yaml")), read_banks(args.run / BANK)
    rules, kinds = config.game, config.bank.classes
    options = rules.agent.step_options(config.step_options)
    with process.single_blas_thread():
        training, held_out = ([getattr(split, part) for split in splits] for part in ("train", "held_out"))
        limits = rules.tolerance, rules.max_iterations
        constant = best_constant_action(kinds, first_scenes(training, held_out), rules.agent, options, *limits)
        print(f"best constant action: {constant.action[0]:.2f}")
        few = [select(bank, np.arange(min(args.scenes, len(bank.initial_cost)))) for bank in held_out]
        game = make_game(rules, kinds, few, config.envs, config.step_options)
        actions = np.array(LAMBDAS)[:, None]
        policies = {"constant action": constant, "learned": load_policy(args.run / "policy.safetensors")}
        taken: dict[str, np.ndarray] = {}
        for (name, policy), looks in itertools.product(policies.items(), (False, True)):
            started, label = time.perf_counter(), f"look-ahead from {name}" if looks else name
            played = look_ahead(game, policy, actions, looks)
            taken[label] = np.concatenate([iterations for iterations, _ in played])
            failures = 1 - np.mean(np.concatenate([success for _, success in played]))
            mean, ratio = np.exp(np.log(taken[label]).mean()), paired_ratio(taken[label], taken["constant action"])
            interval = "{:.3f} [{:.3f}, {:.3f}]".format(*ratio)
            seconds = time.perf_counter() - started
            print(f"{label:30} {mean:.3f} iterations, {interval}, {failures:.1%} never ({seconds:.0f} s)", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
