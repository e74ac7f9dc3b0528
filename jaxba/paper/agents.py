"""The trained agents that the tables compare: one configuration with one change in each, all on the same scenes.

Each agent is trained in its own folder inside the folder of the run. An interrupted training continues there.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxba.damping import LearnedPolicy, load_policy, save_policy
from jaxba.game.env import Game, make_game
from jaxba.game.scene_bank import Bank, Split, select
from jaxba.paper.config import PAPER_STATE, PaperConfig
from jaxba.problem.bundle_problem import ProblemError
from jaxba.problem.options import StepOptions
from jaxba.runtime.atomic import atomic_write
from jaxba.training import config as train_configs
from jaxba.training import driver, task
from jaxba.training.config import TrainConfig

POLICY = "policy.safetensors"
"""File of a trained policy."""

SCENES = "scenes"
"""Folder of the scenes, which all agents share."""

BASELINES = ("ceres",)
"""What training logs are compared with; the tables have baselines of their own."""


@dataclass(frozen=True)
class Agent:
    """One kind of agent."""

    name: str
    """Name in records and folders."""

    overrides: tuple[str, ...] = ()
    """Settings (`key=value`) that differ from the paper's agent."""

    few_scenes: bool = False
    """Whether it is trained on as few scenes as the paper's agent."""


OURS = Agent("agent")
"""The paper's agent, as the configuration interprets the paper."""

FEW = Agent("agent-ten", few_scenes=True)
REDUCTION = Agent("agent-reduction", ("game.reward=reduction",))
REVERSED = Agent("agent-reversed", ("game.reward=reversed", "game.agent.observation=duration"))


def with_state_size(size: int) -> Agent:
    """The agent that observes the last `size` errors."""
    return OURS if size == PAPER_STATE else Agent(f"agent-state-{size}", (f"game.agent.history={size}",))


def train_config(config: PaperConfig, agent: Agent, seed: int) -> TrainConfig:
    """Configuration of one training run, which trains one agent, so that no choice is made among several.

    Raises:
        SettingsError: an override is invalid.
    """
    found = train_configs.load(config.agents.preset, (*config.agents.overrides, *agent.overrides, "seeds=1"))
    return replace(found, seed=config.seed + seed)  # seed of the agent; the scenes are shared


def trained(
    config: PaperConfig, agent: Agent, seed: int, folder: Path, report: Callable[[str], None]
) -> tuple[LearnedPolicy, bool]:
    """The policy of an agent. Trains it if the folder does not have it yet.

    Args:
        config: configuration of the reproduction run.
        agent: the agent.
        seed: number of the training run, from 0.
        folder: folder of the reproduction run.
        report: called with a line of text when something starts.

    Returns:
        The policy, and whether it was trained by this call.

    Raises:
        ProblemError: the training cannot start or continue; the message is one line.
    """
    own = folder / "agents" / f"{agent.name}-{seed}"
    if (own / POLICY).is_file():
        return load_policy(own / POLICY), False
    wanted = train_config(config, agent, seed)
    begun = (own / driver.CONFIG).is_file()
    try:
        settings = driver.prepare_folder(own, wanted, resume=begun)
        _copy_shared_scenes(config, folder, own, report)
        work = task.build(settings, own)
        played = game(config, agent, settings, scenes(config, folder, report)[0])
        note = lambda rows: report(f"{agent.name} {seed + 1}: {rows[0]['chunk']} of {settings.chunks} parts")
        outcome = driver.train(settings, played, work.evaluate, own, driver.Hooks(rows=note))
    except (driver.TrainError, train_configs.SettingsError) as error:
        raise ProblemError(str(error)) from None
    (best,) = outcome.best  # of one agent
    save_policy(own / POLICY, work.policy(best.actor), {"config": train_configs.to_yaml(settings)})
    shutil.rmtree(own / driver.CHECKPOINTS, ignore_errors=True)
    (own / task.BANK).unlink(missing_ok=True)
    return load_policy(own / POLICY), True


def scenes(config: PaperConfig, folder: Path, report: Callable[[str], None]) -> tuple[Bank, Bank]:
    """Scenes for training, and scenes for the tables, which are used neither for training nor to choose a checkpoint.

    The second set is the last part of the shared bank. It is as large as the set by which checkpoints are chosen, the
    first part of it (`Task.chosen_on`), so that one compiled program serves both.

    Raises:
        ProblemError: there are too few scenes.
    """
    split = _shared_scenes(config, folder, report)
    count = len(split.train.initial_cost)
    kept = len(split.held_out.initial_cost)
    if count <= kept:
        raise ProblemError(f"only {count} scenes to train on: draw more (bank.scenes)")
    return select(split.train, np.arange(count - kept)), select(split.train, np.arange(count - kept, count))


def game(config: PaperConfig, agent: Agent, settings: TrainConfig, train_on: Bank) -> Game:
    """The game in which an agent is trained."""
    if agent.few_scenes:
        train_on = select(train_on, np.arange(min(config.agents.trajectories, len(train_on.initial_cost))))
    options = StepOptions(intrinsics=settings.bank.intrinsics)
    return make_game(settings.game, settings.bank.classes, [train_on], settings.envs, options)


def _shared_scenes(config: PaperConfig, folder: Path, report: Callable[[str], None]) -> Split:
    """The scenes of the run. Generates them if the folder does not have them yet."""
    shared = folder / SCENES
    if not all((shared / name).is_file() for name in (task.BANK, task.RULES)):
        shared.mkdir(parents=True, exist_ok=True)
        task.build(train_config(config, OURS, 0), shared, report, BASELINES)
    return task.read_banks(shared / task.BANK)[0]


def _copy_shared_scenes(config: PaperConfig, folder: Path, own: Path, report: Callable[[str], None]) -> None:
    """Copies the scenes of the run into the folder of a training run."""
    _shared_scenes(config, folder, report)
    for name in (task.BANK, task.RULES):
        if not (own / name).is_file():
            with open(folder / SCENES / name, "rb") as source, atomic_write(own / name) as file:
                shutil.copyfileobj(source, file)
