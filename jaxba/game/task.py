"""What a training run is about: scenes, game, and the comparison with hand-written rules on held-out scenes."""

from __future__ import annotations

import json
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping import DampingPolicy, make_policy
from jaxba.damping.learned import Learned, learned_from
from jaxba.game import checkpoint
from jaxba.game.bank import Bank, Split, make_banks
from jaxba.game.config import TrainConfig
from jaxba.game.env import Game, make_game
from jaxba.game.evaluate import Score, compare, evaluate
from jaxba.game.sac import Learner
from jaxba.game.train import TrainError
from jaxba.methods import DEFAULT_METHOD, make_method
from jaxba.options import StepOptions

BANK = "bank.npz"
RULES = "rules.json"

YARDSTICKS = ("ceres", "classic", "gtsam", "gauss-newton", "schedule")
"""Rules that a run is measured against, with plain LM steps."""

EMBEDDED = "+embedded"
"""Ending of the name of a rule that has the embedded iterations of the agent's steps too."""

LEARNED = "learned"
"""Name of the trained policy in tables."""


@dataclass(frozen=True)
class Task:
    """Everything that `train.train` needs, and the yardsticks."""

    config: TrainConfig
    """Of the run."""

    game: Game
    """To train on."""

    held_out: tuple[Bank, ...]
    """Scenes that training never sees, a bank per class."""

    rules: dict[str, Score]
    """Yardsticks on the held-out scenes, `virtual best` among them."""

    def policy(self, actor: Any) -> Learned:
        """The policy of an actor's parameters."""
        return learned_from(self.config.game.agent, actor)

    def evaluate(self, learner: Learner) -> dict[str, float]:
        """On the held-out scenes. `score` is the mean number of iterations, the limit for a failure."""
        rules = self.config.game
        found = evaluate(
            self.config.bank.classes,
            self.held_out,
            self.policy(learner.actor),
            self.game.options,
            rules.tolerance,
            rules.max_iterations,
        )
        numbers = found._asdict()
        return {"score": numbers.pop("mean"), **numbers}

    def compare(self, actor: Any) -> dict[str, Score]:
        """A trained policy beside the yardsticks; the virtual best is that of the rules."""
        with_policy = _compare(self.config, self.held_out, {LEARNED: (self.policy(actor), self.game.options)})
        return {LEARNED: with_policy[LEARNED], **self.rules}


def build(
    config: TrainConfig,
    folder: Path,
    say: Callable[[str], None] = lambda _: None,
    yardsticks: Sequence[str] | None = None,
) -> Task:
    """Makes banks and yardsticks, or reads those that an earlier call left in the folder.

    Args:
        config: of the run that the folder belongs to.
        folder: of the run.
        say: told in words what begins.
        yardsticks: rules to measure against where that has not been done yet; `YARDSTICKS` if None.

    Raises:
        ValueError: too few scenes are of use. One line for a person.
    """
    path = folder / BANK
    if path.is_file():
        say("reading the scenes")
        splits = read_banks(path)
    else:
        key = jax.random.key(config.seed)
        splits = make_banks(config.bank, key, config.bank.options, config.game.max_iterations, say)
        _write_banks(path, splits)
    banks = [split.train for split in splits]
    game = make_game(config.game, config.bank.classes, banks, config.envs, config.step_options)
    held_out = tuple(split.held_out for split in splits)
    return Task(config, game, held_out, _rules(config, game, held_out, folder / RULES, say, yardsticks or YARDSTICKS))


def _rules(
    config: TrainConfig,
    game: Game,
    held_out: tuple[Bank, ...],
    path: Path,
    say: Callable[[str], None],
    yardsticks: Sequence[str],
) -> dict[str, Score]:
    if path.is_file():
        return {name: Score(**numbers) for name, numbers in json.loads(path.read_text(encoding="utf-8")).items()}
    say("hand-written rules on the held-out scenes")
    plain = config.step_options
    own = () if config.method == DEFAULT_METHOD else (make_method(config.method).rule,)
    names = tuple(dict.fromkeys((*own, *yardsticks)))
    policies: dict[str, tuple[DampingPolicy, StepOptions]] = {name: (make_policy(name), plain) for name in names}
    embedded = replace(game.options, camera_damping=plain.camera_damping)
    if embedded != plain:
        policies[yardsticks[0] + EMBEDDED] = make_policy(yardsticks[0]), embedded
    scores = _compare(config, held_out, policies)
    part = path.with_suffix(".part")
    part.write_text(json.dumps({name: score._asdict() for name, score in scores.items()}, indent=1), encoding="utf-8")
    part.replace(path)
    return scores


def _compare(
    config: TrainConfig, held_out: tuple[Bank, ...], policies: Mapping[str, tuple[DampingPolicy, StepOptions]]
) -> dict[str, Score]:
    return compare(config.bank.classes, held_out, policies, config.game.tolerance, config.game.max_iterations)


def _write_banks(path: Path, splits: list[Split]) -> None:
    part = path.with_suffix(".part")
    with part.open("wb") as file:
        arrays: dict[str, Any] = {name.replace(".", "/"): x for name, x in checkpoint.pack(splits).items()}
        np.savez(file, **arrays)
    part.replace(path)


def read_banks(path: Path) -> list[Split]:
    """The scenes of a run's folder.

    Raises:
        TrainError: another version wrote them.
    """
    with np.load(path) as file:
        classes = sorted({int(name.split("/")[0]) for name in file.files})
        try:
            return [_named_tuple(Split, f"{number}/", file) for number in classes]
        except KeyError as error:
            raise TrainError(f"{path}: written by another version ({error.args[0]}); begin in a new folder") from None


def _named_tuple(kind: Any, prefix: str, arrays: Mapping[str, np.ndarray]) -> Any:
    """Puts nested named tuples together again, by the types of their fields."""
    values = {}
    for name, inner in typing.get_type_hints(kind).items():
        nested = isinstance(inner, type) and hasattr(inner, "_fields")
        values[name] = _named_tuple(inner, f"{prefix}{name}/", arrays) if nested else jnp.asarray(arrays[prefix + name])
    return kind(**values)
