"""The trained agents that the tables compare: the paper's as printed and as tuned, the best one for
lambda alone, and those of the ablations, which change one setting of the tuned one; all on the same
scenes.

Each agent is trained in its own folder inside the folder of the run. An interrupted training
continues there."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from jaxba.bench.sources import Source
from jaxba.damping import save_policy
from jaxba.damping.learned import always
from jaxba.game.env import Game, make_game
from jaxba.game.evaluate import best_constant_action
from jaxba.game.scene_bank import Bank, Split, select
from jaxba.paper import real_problems
from jaxba.paper.config import PAPER_STATE, PaperConfig
from jaxba.problem.bundle_problem import ProblemError
from jaxba.settings import to_yaml
from jaxba.training import config as train_configs
from jaxba.training import driver, log, task, view
from jaxba.training.config import TrainConfig
from jaxba.training.task import Task

# file of the trained policy of an agent's training run, by its number from 1
POLICY = "policy-{}.safetensors"
# folder of the synthetic scenes, which all agents but those for real problems share
SCENES = "scenes"
# what training logs are compared with; the tables have baselines of their own
BASELINES = ("ceres",)


@dataclass(frozen=True)
class Agent:
    """One kind of agent."""

    name: str  # in records and folders
    preset: str = "paper-tuned"  # of `jaxba-train`
    overrides: tuple[str, ...] = ()  # settings (`key=value`) that differ from the preset
    few_scenes: bool = False  # whether it is trained on as few scenes as the paper's agent
    # files of real problems, on windows of which it is trained, if any
    problems: tuple[str, ...] = ()


# the paper's agent with what it takes to learn; the ablations change one of its settings each
OURS = Agent("agent")
PRINTED = Agent("agent-printed", "paper")  # the paper's agent with the settings that it prints
# the best agent for lambda alone: scale-free observations, and the guard
BEST = Agent("agent-guarded", "default")
# mean duration of an iteration, for a bonus of 10. Source: the paper on BAL, 110 s in 20 of classic
SECONDS = 5.5
# with a bonus of 10
BY_THE_CLOCK = ("game.reward=clock", f"game.scale={0.1 * SECONDS}", f"game.bonus={10 / SECONDS}")

FEW = replace(OURS, name="agent-ten", few_scenes=True)
REDUCTION = replace(OURS, name="agent-reduction", overrides=("game.reward=reduction",))
CLOCK = replace(OURS, name="agent-clock", overrides=BY_THE_CLOCK)
REVERSED = replace(
    OURS,
    name="agent-reversed",
    overrides=("game.reward=reversed", "game.agent.observation=duration"),
)

WINDOWS = ("bank.kind={cameras: 10, points: 40}", "bank.scenes=200", "bank.refine_points=3")
"""Windows of agents for real problems. With ten points, most cameras would have too few
observations."""


def trained_elsewhere(
    config: PaperConfig, source: Source, kind: Agent, method: str = "lm"
) -> Agent | None:
    """The agent for a real problem, trained on others (`real_problems.training_files`) with a
    method; None without."""
    left_out, files = real_problems.training_files(config.real, source)
    if not files:
        return None
    lens = "fixed" if source.family == config.real.kitti.name else "free"
    overrides = (*kind.overrides, *WINDOWS, f"bank.intrinsics={lens}", f"method={method}")
    name = f"{kind.name}-{method}-without-{left_out}"
    return replace(kind, name=name, overrides=overrides, problems=files)


def with_state_size(size: int) -> Agent:
    """The agent that observes the last `size` errors."""
    other = replace(OURS, name=f"agent-state-{size}", overrides=(f"game.agent.history={size}",))
    return OURS if size == PAPER_STATE else other


def train_config(config: PaperConfig, agent: Agent) -> TrainConfig:
    """Configuration of an agent's training runs on the paper's game. Raises SettingsError: an
    invalid override."""
    changes = (
        *config.agents.overrides,
        *agent.overrides,
        f"seeds={config.agents.seeds}",
        f"seed={config.seed}",
    )
    found = train_configs.load(agent.preset, changes)
    bank = train_configs.load(OURS.preset, changes).bank
    found = replace(found, bank=bank, chunks=max(1, round(config.agents.length * found.chunks)))
    return train_configs.with_problems(found, agent.problems) if agent.problems else found


def updates(config: PaperConfig, agent: Agent) -> int:
    """Updates of the networks in a training run."""
    found = train_config(config, agent)
    return found.chunks * found.loop.steps_per_chunk * found.loop.updates_per_step


def own_folder(agent: Agent, folder: Path) -> Path:
    """The folder of an agent in that of the reproduction run."""
    return folder / "agents" / agent.name


def train(config: PaperConfig, agent: Agent, folder: Path, report: Callable[[str], None]) -> bool:
    """Trains an agent whose policies the run's folder lacks; `report` is called with a line when
    something starts. Returns whether it did. Raises InputError: the training cannot start or
    continue; one line."""
    own = own_folder(agent, folder)
    files = [own / POLICY.format(seed + 1) for seed in range(config.agents.seeds)]
    if all(file.is_file() for file in files):
        return False
    begun = (own / driver.CONFIG).is_file()
    settings = driver.prepare_folder(own, train_config(config, agent), resume=begun)
    work, played = game_of(config, agent, folder, report)

    def note(rows):
        return report(f"{agent.name}: {rows[0]['chunk']} of {settings.chunks} parts")

    outcome = driver.train(settings, played, work.evaluate, own, driver.Hooks(rows=note))
    # every run's own, so that no choice is made among them
    for file, best in zip(files, outcome.best, strict=True):
        save_policy(file, work.policy(best.actor), {"config": to_yaml(settings)})
    shutil.rmtree(own / driver.CHECKPOINTS, ignore_errors=True)
    return True


def best_constant(
    config: PaperConfig, agent: Agent, folder: Path, report: Callable[[str], None]
) -> Path:
    """The file of an agent's twin without learning, which this makes if it is not there: the
    constant action with the fewest iterations on the agent's training scenes, under the same guard
    and step."""
    path = folder / "agents" / f"{agent.name}-constant.safetensors"
    if not path.is_file():
        report(f"{agent.name}: best constant action")
        work, played = game_of(config, agent, folder, report)
        bank = task.first_scenes(played.bank, work.held_out)
        found = best_constant_action(played.kind, bank, played.config, played.options)
        path.parent.mkdir(parents=True, exist_ok=True)
        save_policy(path, always(found, played.config.agent))
    return path


def collapsed(config: PaperConfig, agent: Agent, folder: Path) -> list[bool]:
    """Of every training run, whether its policy did the same in every state in the end; none before
    it is trained."""
    rows = log.read(own_folder(agent, folder))
    wired = train_config(config, agent).game.agent
    decades = (wired.high - wired.low) / 2
    return [
        decades * row["action_spread"] < view.SAME
        for row in rows
        if row["chunk"] == rows[-1]["chunk"]
    ]


def game_of(
    config: PaperConfig, agent: Agent, folder: Path, report: Callable[[str], None]
) -> tuple[Task, Game]:
    """The task of an agent, and the game in which it is trained, without the scenes of the
    tables."""
    settings = train_config(config, agent)
    _shared_scenes(config, agent, folder, report)
    work = task.build(settings, _scenes_folder(agent, folder))
    return work, work.game if agent.problems else game(
        config, agent, settings, scenes(config, folder, report)[0]
    )


def scenes(config: PaperConfig, folder: Path, report: Callable[[str], None]) -> tuple[Bank, Bank]:
    """Scenes for training, and scenes for the tables, which are used neither for training nor to
    choose a checkpoint.

    The second set is the last part of the shared bank. It is as large as the set by which
    checkpoints are chosen, the first part of it (`Task.chosen_on`), so that one compiled program
    serves both. Raises ProblemError: there are too few scenes."""
    split = _shared_scenes(config, OURS, folder, report)
    count = len(split.train.initial_cost)
    kept = len(split.held_out.initial_cost)
    if count <= kept:
        raise ProblemError(f"only {count} scenes to train on: draw more (bank.scenes)")
    return select(split.train, np.arange(count - kept)), select(
        split.train, np.arange(count - kept, count)
    )


def game(config: PaperConfig, agent: Agent, settings: TrainConfig, train_on: Bank) -> Game:
    """The game in which an agent is trained."""
    if agent.few_scenes:
        train_on = select(
            train_on, np.arange(min(config.agents.trajectories, len(train_on.initial_cost)))
        )
    return make_game(
        settings.game, settings.bank.kind, train_on, settings.envs, settings.step_options
    )


def _shared_scenes(
    config: PaperConfig, agent: Agent, folder: Path, report: Callable[[str], None]
) -> Split:
    """The scenes of an agent's training. Generates them if the folder does not have them yet."""
    shared = _scenes_folder(agent, folder)
    if not all((shared / name).is_file() for name in (task.BANK, task.RULES)):
        shared.mkdir(parents=True, exist_ok=True)
        task.build(
            train_config(config, agent if agent.problems else OURS), shared, report, BASELINES
        )
    return task.read_split(shared / task.BANK)


def _scenes_folder(agent: Agent, folder: Path) -> Path:
    return folder / (
        f"{SCENES}-{agent.name.rpartition('-without-')[2]}" if agent.problems else SCENES
    )
