"""What a training run consists of: scenes, game, and the comparison with baselines on held-out
scenes."""

from __future__ import annotations

import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, TypeAlias

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping import DampingPolicy, make_policy
from jaxba.damping.learned import LearnedPolicy, always, learned_from
from jaxba.damping.registry import BOLD, LEARNED
from jaxba.game.env import Game, make_game
from jaxba.game.evaluate import (
    Score,
    best_constant_action,
    best_costs,
    evaluate,
    iterations_to,
    play_all,
    scores,
)
from jaxba.game.rollout import Trajectories
from jaxba.game.scene_bank import Bank, Split, make_split, select
from jaxba.game.statistics import paired_ratio
from jaxba.problem.options import StepOptions
from jaxba.solver.methods import DEFAULT_METHOD, make_method
from jaxba.training import checkpoint
from jaxba.training.checkpoint import TrainError
from jaxba.training.config import TrainConfig

BANK = "bank.npz"
RULES = "rules.npz"

CONSTANT = "constant action"  # name of the best constant action on training scenes

BASELINES = ("ceres", "classic", "gtsam", "gauss-newton", "schedule", BOLD, LEARNED, CONSTANT)
"""Rules and the shipped network with plain steps; `bold` and the constant action with the agent's
guard and step."""

TRAINED = "trained"  # name of the trained policy in tables

Comparison: TypeAlias = tuple[
    dict[str, Score], dict[str, tuple[float, float, float]], dict[str, list[float]]
]
"""Trained policies on the held-out scenes: scores by name (of every agent if there are several, the
mean of all agents, and of the baselines); iterations of the trained policies over those of each
baseline, scene by scene (`paired_ratio`), geometric mean over agents; and the same for every
agent."""


@dataclass(frozen=True)
class Task:
    """Everything that `driver.train` needs, and the baselines."""

    config: TrainConfig  # of the run
    game: Game  # to train on
    held_out: Bank  # scenes that training never sees
    baseline_runs: dict[str, Trajectories]  # what the baselines did on the held-out scenes

    @cached_property
    def rules(self) -> dict[str, Score]:
        """Scores of the baselines, and of their `virtual best`."""
        game = self.config.game
        return scores({}, self.baseline_runs, self.held_out, game.tolerance, game.max_iterations)

    def policy(self, actor: Any) -> LearnedPolicy:
        """The policy of an actor's parameters."""
        return learned_from(self.config.game.agent, actor)

    @cached_property
    def chosen_on(self) -> Bank:
        """Training scenes by which policies are chosen (`first_scenes`)."""
        return first_scenes(self.game.bank, self.held_out)

    def evaluate(self, actor: Any) -> dict[str, float]:
        """Scores of a policy by their names in the log. `training/score` chooses among policies: on
        training scenes, the mean number of iterations, the limit for a failure. Those on held-out
        scenes are for the eye alone."""
        rules = self.config.game
        found = {}
        for name, bank in (("training", self.chosen_on), ("held_out", self.held_out)):
            arguments = self.policy(actor), self.game.options, rules.tolerance, rules.max_iterations
            scored = evaluate(self.game.kind, bank, *arguments)
            fields = scored._asdict()
            found |= {f"{name}/score": fields.pop("mean")} | {
                f"{name}/{field}": x for field, x in fields.items()
            }
        return found

    def compare(self, actors: Sequence[Any]) -> Comparison:
        """Trained policies beside the baselines, relative to the best costs of all."""
        tolerance = self.config.game.tolerance
        limit = self.config.game.max_iterations
        names = [f"{TRAINED} {k + 1}" for k in range(len(actors))]
        steps = {
            name: (self.policy(actor), self.game.options)
            for name, actor in zip(names, actors, strict=True)
        }
        alone = play_all(self.game.kind, self.held_out, steps, limit)
        best = best_costs({**alone, **self.baseline_runs}, self.held_out)
        found = scores(alone, self.baseline_runs, self.held_out, tolerance, limit)
        each = {name: found.pop(name) for name in names}
        mean = Score(*(float(x) for x in np.mean(list(each.values()), axis=0)))

        def taken(run):
            return np.log(np.minimum(iterations_to(run, best, tolerance), limit))

        ours = np.stack([taken(alone[name]) for name in names])
        ratios = {}
        by_agent = {}
        for name, run in self.baseline_runs.items():
            theirs = taken(run)
            ratios[name] = paired_ratio(np.exp(ours.mean(axis=0)), np.exp(theirs))
            by_agent[name] = np.exp(np.mean(ours - theirs, axis=1)).tolist()
        return {**(each if len(actors) > 1 else {}), TRAINED: mean, **found}, ratios, by_agent


def first_scenes(training: Bank, held_out: Bank) -> Bank:
    """The first scenes of the training bank, as many as are held out."""
    return select(training, np.arange(min(len(training.initial_cost), len(held_out.initial_cost))))


def build(
    config: TrainConfig,
    folder: Path,
    report: Callable[[str], None] = lambda _: None,
    baselines: Sequence[str] | None = None,
    on_game: Callable[[Game], Any] = lambda _: None,
) -> Task:
    """Makes scenes and plays the baselines, or reads what an earlier call left in the folder.
    `report` is called with a line when something long begins; `baselines` are names to compare
    with, unless the folder has results; `BASELINES` if None; `on_game` is called with the game
    first. Raises ValueError: too few scenes are usable, or another version wrote the files; one
    line for a person. Raises OSError: the folder cannot be written or read."""
    path = folder / BANK
    if path.is_file():
        report("reading the scenes")
        split = read_split(path)
    else:
        key = jax.random.key(config.seed)
        limit = config.game.max_iterations
        split = make_split(
            config.bank, key, config.bank.options, limit, report, config.game.tolerance
        )
        _write_split(path, split)
    game = make_game(config.game, config.bank.kind, split.train, config.envs, config.step_options)
    on_game(game)
    runs = _baseline_runs(config, folder, game, split.held_out, report, baselines)
    return Task(config, game, split.held_out, runs)


def _baseline_runs(
    config: TrainConfig,
    folder: Path,
    game: Game,
    held_out: Bank,
    report: Callable[[str], None],
    baselines: Sequence[str] | None,
) -> dict[str, Trajectories]:
    path = folder / RULES
    if path.is_file():
        return _read_runs(path)
    report("baselines on the held-out scenes")
    names = list(baselines or BASELINES)
    policies = baseline_policies(config, game.options, [name for name in names if name != CONSTANT])
    if CONSTANT in names:
        bank = first_scenes(game.bank, held_out)
        found = best_constant_action(game.kind, bank, config.game, game.options, policies)
        policies[CONSTANT] = always(found, config.game.agent), game.options
    # in the order of the table
    runs = play_all(game.kind, held_out, policies, config.game.max_iterations)
    arrays = {
        f"{name}/{field}": x for name, run in runs.items() for field, x in run._asdict().items()
    }
    checkpoint.write_arrays(path, arrays)
    return runs


def baseline_policies(
    config: TrainConfig, options: StepOptions, names: Sequence[str]
) -> dict[str, tuple[DampingPolicy, StepOptions]]:
    """Policy and step of every baseline, in the order of the table; `options` are those of the
    agent's step. Names are as in `BASELINES`, without `CONSTANT`; the rule that belongs to the
    method comes first."""
    own = () if config.method == DEFAULT_METHOD else (make_method(config.method).rule,)
    found = {name: (make_policy(name), config.step_options) for name in (*own, *names)}
    return found | ({BOLD: (always(-1.0, config.game.agent), options)} if BOLD in found else {})


def _write_split(path: Path, split: Split) -> None:
    checkpoint.write_arrays(
        path, {name.replace(".", "/"): x for name, x in checkpoint.pack(split).items()}
    )


def read_split(path: Path) -> Split:
    """The scenes of a run's folder. Raises TrainError: another version wrote them, or the file is
    damaged."""
    return _named_tuple(path, Split, "", _read(path))


def _read_runs(path: Path) -> dict[str, Trajectories]:
    arrays = _read(path)
    names = dict.fromkeys(name.rpartition("/")[0] for name in arrays)
    return {
        name: _named_tuple(path, Trajectories, f"{name}/", arrays, np.asarray) for name in names
    }


def _read(path: Path) -> dict[str, np.ndarray]:
    try:
        return checkpoint.read_arrays(path)
    except TrainError as error:
        raise TrainError(f"{path}: {error}; begin in a new folder") from None


def _named_tuple(
    path: Path,
    kind: Any,
    prefix: str,
    arrays: Mapping[str, np.ndarray],
    make: Callable[[Any], Any] = jnp.asarray,
) -> Any:
    """Rebuilds nested named tuples from the types of their fields."""
    values = {}
    for name, inner in typing.get_type_hints(kind).items():
        if isinstance(inner, type) and hasattr(inner, "_fields"):
            values[name] = _named_tuple(path, inner, f"{prefix}{name}/", arrays, make)
        elif (key := prefix + name) in arrays:
            values[name] = make(arrays[key])
        else:
            raise TrainError(
                f"{path}: written by another version ({key} is missing); begin in a new folder"
            )
    return kind(**values)
