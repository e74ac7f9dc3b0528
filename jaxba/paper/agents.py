"""The trained agents that the tables compare: one configuration with one change in each, all on the same scenes.

Each agent is trained in its own folder inside the folder of the run. An interrupted training continues there.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxba.bench.sources import Source
from jaxba.damping import LearnedPolicy, load_policy, save_policy
from jaxba.game.env import Game, make_game
from jaxba.game.scene_bank import Bank, Split, select
from jaxba.paper import real_problems
from jaxba.paper.config import PAPER_STATE, PaperConfig
from jaxba.problem.bundle_problem import ProblemError
from jaxba.settings import to_yaml
from jaxba.training import config as train_configs
from jaxba.training import driver, task
from jaxba.training.config import TrainConfig

POLICY = "policy.safetensors"
"""File of a trained policy."""

SCENES = "scenes"
"""Folder of the synthetic scenes, which all agents but those for real problems share."""

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

    problems: tuple[str, ...] = ()
    """Files of real problems, on windows of which it is trained; on the synthetic scenes if empty."""


OURS = Agent("agent")
"""The paper's agent, as the configuration interprets the paper."""

SECONDS = 5.5
"""Mean duration of an iteration by the clock, against a bonus of 10. Source: the paper's table on BAL, 110 s of 20
iterations of classic."""

BY_THE_CLOCK = ("game.reward=clock", f"game.scale={SECONDS}", f"game.bonus={10 / SECONDS}")
"""Reward of minus the duration in seconds, and a bonus of 10: the scale is a factor on both."""

FEW = Agent("agent-ten", few_scenes=True)
REDUCTION = Agent("agent-reduction", ("game.reward=reduction",))
CLOCK = Agent("agent-clock", BY_THE_CLOCK)
REVERSED = Agent("agent-reversed", ("game.reward=reversed", "game.agent.observation=duration"))

WINDOWS = ("bank.classes=[{cameras: 10, points: 40}]", "bank.scenes=[400]")
"""Windows of an agent that is trained on real problems. Ten points, as in the synthetic scenes, would leave most
cameras of a window with too few observations."""


def trained_elsewhere(config: PaperConfig, source: Source) -> Agent | None:
    """The agent for a real problem, trained on other ones (`real_problems.training_files`); None if there are none."""
    left_out, files = real_problems.training_files(config.real, source)
    if not files:
        return None
    return Agent(f"agent-without-{left_out}", (*WINDOWS, *BY_THE_CLOCK), problems=files)


def with_state_size(size: int) -> Agent:
    """The agent that observes the last `size` errors."""
    return OURS if size == PAPER_STATE else Agent(f"agent-state-{size}", (f"game.agent.history={size}",))


def train_config(config: PaperConfig, agent: Agent, seed: int) -> TrainConfig:
    """Configuration of one training run, which trains one agent, so that no choice is made among several.

    Raises:
        SettingsError: an override is invalid.
    """
    found = train_configs.load(config.agents.preset, (*config.agents.overrides, *agent.overrides, "seeds=1"))
    found = train_configs.with_problems(found, agent.problems) if agent.problems else found
    return replace(found, seed=config.seed + seed)  # seed of the agent; the scenes are shared


def updates(config: PaperConfig) -> int:
    """Updates of the networks in a training run."""
    found = train_config(config, OURS, 0)
    return found.chunks * found.loop.steps_per_chunk * found.loop.updates_per_step


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
        InputError: the training cannot start or continue; the message is one line.
    """
    own = folder / "agents" / f"{agent.name}-{seed}"
    if (own / POLICY).is_file():
        return load_policy(own / POLICY), False
    wanted = train_config(config, agent, seed)
    begun = (own / driver.CONFIG).is_file()
    settings = driver.prepare_folder(own, wanted, resume=begun)
    _shared_scenes(config, agent, folder, report)
    work = task.build(settings, _scenes_folder(agent, folder))
    played = work.game if agent.problems else game(config, agent, settings, scenes(config, folder, report)[0])
    note = lambda rows: report(f"{agent.name} {seed + 1}: {rows[0]['chunk']} of {settings.chunks} parts")
    outcome = driver.train(settings, played, work.evaluate, own, driver.Hooks(rows=note))
    (best,) = outcome.best  # of one agent
    save_policy(own / POLICY, work.policy(best.actor), {"config": to_yaml(settings)})
    shutil.rmtree(own / driver.CHECKPOINTS, ignore_errors=True)
    return load_policy(own / POLICY), True


def scenes(config: PaperConfig, folder: Path, report: Callable[[str], None]) -> tuple[Bank, Bank]:
    """Scenes for training, and scenes for the tables, which are used neither for training nor to choose a checkpoint.

    The second set is the last part of the shared bank. It is as large as the set by which checkpoints are chosen, the
    first part of it (`Task.chosen_on`), so that one compiled program serves both.

    Raises:
        ProblemError: there are too few scenes.
    """
    split = _shared_scenes(config, OURS, folder, report)
    count = len(split.train.initial_cost)
    kept = len(split.held_out.initial_cost)
    if count <= kept:
        raise ProblemError(f"only {count} scenes to train on: draw more (bank.scenes)")
    return select(split.train, np.arange(count - kept)), select(split.train, np.arange(count - kept, count))


def game(config: PaperConfig, agent: Agent, settings: TrainConfig, train_on: Bank) -> Game:
    """The game in which an agent is trained."""
    if agent.few_scenes:
        train_on = select(train_on, np.arange(min(config.agents.trajectories, len(train_on.initial_cost))))
    return make_game(settings.game, settings.bank.classes, [train_on], settings.envs, settings.step_options)


def _shared_scenes(config: PaperConfig, agent: Agent, folder: Path, report: Callable[[str], None]) -> Split:
    """The scenes of an agent's training runs. Generates them if the folder does not have them yet."""
    shared = _scenes_folder(agent, folder)
    if not all((shared / name).is_file() for name in (task.BANK, task.RULES)):
        shared.mkdir(parents=True, exist_ok=True)
        task.build(train_config(config, agent if agent.problems else OURS, 0), shared, report, BASELINES)
    return task.read_banks(shared / task.BANK)[0]


def _scenes_folder(agent: Agent, folder: Path) -> Path:
    return folder / (f"{SCENES}-{agent.name}" if agent.problems else SCENES)
