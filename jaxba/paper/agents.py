"""The agents that the tables compare: one preset, one thing changed in each, all on the same scenes.

An agent is trained by `jaxba.game.train`, in a folder of its own inside the run's, and goes on there after a kill.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxba.damping import LearnedPolicy, load_policy, save_policy
from jaxba.game.env import Game, make_game
from jaxba.game.scene_bank import Bank, Split, sieve
from jaxba.paper.config import PAPER_STATE, PaperConfig
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.options import StepOptions
from jaxba.runtime.atomic import atomic_write
from jaxba.training import config as train_configs
from jaxba.training import driver, task
from jaxba.training.config import TrainConfig

POLICY = "policy.safetensors"
SCENES = "scenes"
"""Folder of the scenes that all agents share."""

YARDSTICKS = ("ceres",)
"""Rules that training logs are measured against; the tables have their own."""


@dataclass(frozen=True)
class Agent:
    """One kind of agent."""

    name: str
    """In records and folders."""

    overrides: tuple[str, ...] = ()
    """What is changed about the paper's own agent."""

    few_scenes: bool = False
    """Whether it is trained on as few scenes as the paper's."""


OURS = Agent("agent")
"""The paper's agent as the preset reads the paper."""

FEW = Agent("agent-ten", few_scenes=True)
REDUCTION = Agent("agent-reduction", ("game.reward=reduction",))
REVERSED = Agent("agent-reversed", ("game.reward=reversed", "game.agent.observation=duration"))


def of_state(size: int) -> Agent:
    """The agent that sees so many last errors."""
    return OURS if size == PAPER_STATE else Agent(f"agent-state-{size}", (f"game.agent.history={size}",))


def train_config(config: PaperConfig, agent: Agent, seed: int) -> TrainConfig:
    """Of one training run: one agent, so that none is picked among several.

    Raises:
        SettingsError: a wrong override.
    """
    found = train_configs.load(config.agents.preset, (*config.agents.overrides, *agent.overrides, "seeds=1"))
    return replace(found, seed=config.seed + seed)  # the agent's: the scenes are those of the shared folder


def trained(
    config: PaperConfig, agent: Agent, seed: int, folder: Path, say: Callable[[str], None]
) -> tuple[LearnedPolicy, bool]:
    """The policy of an agent, trained now if that is not done.

    Args:
        config: of the reproduction run.
        agent: which.
        seed: number of the training run, from 0.
        folder: of the reproduction run.
        say: told in words what begins.

    Returns:
        The policy, and whether anything had to be done.

    Raises:
        ProblemError: the training cannot start or go on; one line.
    """
    own = folder / "agents" / f"{agent.name}-{seed}"
    if (own / POLICY).is_file():
        return load_policy(own / POLICY), False
    wanted = train_config(config, agent, seed)
    begun = (own / driver.CONFIG).is_file()
    try:
        settings = driver.prepare_folder(own, wanted, resume=begun)
        _share(config, folder, own, say)
        work = task.build(settings, own)
        played = game(config, agent, settings, scenes(config, folder, say)[0])
        note = lambda row: say(f"{agent.name} {seed + 1}: {row['chunk']} of {settings.chunks} parts")
        outcome = driver.train(settings, played, work.evaluate, own, driver.Hooks(row=note))
    except (driver.TrainError, train_configs.SettingsError) as error:
        raise ProblemError(str(error)) from None
    if outcome.best is None:
        raise AssertionError("a finished training has been evaluated")
    save_policy(own / POLICY, work.policy(outcome.best.actor), {"config": train_configs.to_yaml(settings)})
    shutil.rmtree(own / driver.CHECKPOINTS, ignore_errors=True)
    (own / task.BANK).unlink(missing_ok=True)
    return load_policy(own / POLICY), True


def scenes(config: PaperConfig, folder: Path, say: Callable[[str], None]) -> tuple[Bank, Bank]:
    """Scenes to train on, and the tables' own, which neither training nor the choice of a checkpoint sees.

    The latter are the last ones of the shared bank, as many as there are to choose checkpoints by, so that one compiled
    program plays both.
    """
    split = _shared(config, folder, say)
    count = len(split.train.initial_cost)
    kept = len(split.held_out.initial_cost)
    if count <= kept:
        raise ProblemError(f"only {count} scenes to train on: draw more (bank.scenes)")
    return sieve(split.train, np.arange(count - kept)), sieve(split.train, np.arange(count - kept, count))


def game(config: PaperConfig, agent: Agent, settings: TrainConfig, train_on: Bank) -> Game:
    """What an agent plays."""
    if agent.few_scenes:
        train_on = sieve(train_on, np.arange(min(config.agents.trajectories, len(train_on.initial_cost))))
    options = StepOptions(intrinsics=settings.bank.intrinsics)
    return make_game(settings.game, settings.bank.classes, [train_on], settings.envs, options)


def _shared(config: PaperConfig, folder: Path, say: Callable[[str], None]) -> Split:
    """The run's one bank, made for the first who asks."""
    shared = folder / SCENES
    if not all((shared / name).is_file() for name in (task.BANK, task.RULES)):
        shared.mkdir(parents=True, exist_ok=True)
        task.build(train_config(config, OURS, 0), shared, say, YARDSTICKS)
    return task.read_banks(shared / task.BANK)[0]


def _share(config: PaperConfig, folder: Path, own: Path, say: Callable[[str], None]) -> None:
    """Puts the run's bank into the folder of a training run."""
    _shared(config, folder, say)
    for name in (task.BANK, task.RULES):
        if not (own / name).is_file():
            with open(folder / SCENES / name, "rb") as source, atomic_write(own / name) as file:
                shutil.copyfileobj(source, file)
