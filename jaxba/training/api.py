"""The game and its trainer from Python: `jaxba.make_env` and `jaxba.train`."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jax
import numpy as np

from jaxba.damping.learned import LearnedPolicy
from jaxba.game.env import Game, Reward, RewardFunction, make_game
from jaxba.game.scene_bank import Bank, make_split
from jaxba.io.files import StrPath
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.runtime import process
from jaxba.runtime.numerics import numerics
from jaxba.training import driver
from jaxba.training.config import TrainConfig, load, with_problems
from jaxba.training.task import Task
from jaxba.typing import register_pytree

if TYPE_CHECKING:
    from jaxba.game.gym import GymGame, GymVectorGame

EVALUATIONS = 10  # evaluations of a training, after equal parts of it


@register_pytree
@dataclass(frozen=True)
class PresetGame(Game):
    """A game with the settings that an agent is trained with."""

    held_out: Bank  # scenes that no training sees
    preset: TrainConfig = field(metadata={"static": True})  # everything else


def make_env(
    preset: str = "paper",
    *overrides: str,
    problems: Sequence[StrPath | BundleProblem] = (),
    reward: Reward | RewardFunction | None = None,
    report: Callable[[str], None] = lambda _: None,
) -> PresetGame:
    """The game of a preset: an environment of many scenes that step together.

    It has `reset(key)` and `step(state, actions)`, pure functions that may be jitted, and
    `num_envs`, `observation_size` and `action_size`; see `game/protocol.py`. They run in 64 bits
    (`jax.enable_x64(True)`).

    Args:
        preset: name of a preset of `jaxba-train`, or the path of a YAML file.
        overrides: settings that replace those of the preset, as `"sac.width=128"`.
        problems: scenes of your own instead of random ones: windows of neighbouring cameras are cut
            from these problems, in memory or files, and the last fifth of every problem is held
            out.
        reward: instead of the preset's: a name, or a function of the iteration (`StepInfo`), the
            best known cost of the scene and whether the episode has ended in success. It is traced,
            returns one number, and gets neither scale nor bonus.
        report: called with a line of text when something begins that takes a while.

    Raises:
        SettingsError: no such preset, or an impossible setting.
        InputError: no scene would be left to train on, or the problems are no source of windows.
        ValueError: the reward is no such function."""
    config = load(preset, overrides)
    if problems:
        names = [
            f"problem {k}" if isinstance(x, BundleProblem) else str(x)
            for k, x in enumerate(problems)
        ]
        config = with_problems(config, names)
    rules = config.game if reward is None else replace(config.game, reward=reward)
    config = replace(config, game=rules)
    with numerics(np.float64), process.single_blas_thread():
        key = jax.random.key(config.seed)
        limit = rules.max_iterations
        split = make_split(
            config.bank, key, config.bank.options, limit, report, rules.tolerance, problems
        )
        game = make_game(rules, config.bank.kind, split.train, config.envs, config.step_options)
    return PresetGame(
        *(getattr(game, name) for name in vars(game)), held_out=split.held_out, preset=config
    )


def train(
    env: PresetGame,
    steps: int,
    *,
    seeds: int = 1,
    seed: int = 0,
    folder: StrPath | None = None,
    verbose: bool = False,
) -> LearnedPolicy:
    """Trains agents by Soft Actor-Critic in one compiled loop; the policy that is best on training
    scenes.

    Compare it with the best constant action before you believe in it: `jaxba-train` does.

    Args:
        env: of `make_env`.
        steps: iterations of scenes that every agent plays, over all environments, after
            `loop.warmup_steps`.
        seeds: agents that are trained side by side.
        seed: of the agents' random numbers; the scenes are those of the environment.
        folder: keeps log and checkpoints there, and goes on from the last one; None: they are
            dropped.
        verbose: whether a line is printed after each part of the training.

    Returns:
        A policy for `jaxba.solve`, `jaxba.save_policy` and `jaxba-bench`.

    Raises:
        ValueError: an impossible number.
        TrainError: losses or all transitions are not finite, or the folder holds another run."""
    if not isinstance(env, PresetGame):
        raise ValueError(f"env must be a game of jaxba.make_env, not {env!r}")
    if steps < 1:
        raise ValueError(f"steps must be at least 1, not {steps}")
    rounds = -(-steps // env.num_envs)
    chunks = min(EVALUATIONS, rounds)
    loop = replace(env.preset.loop, steps_per_chunk=-(-rounds // chunks))
    config = replace(env.preset, seeds=seeds, seed=seed, chunks=chunks, evaluate_every=1, loop=loop)
    work = Task(config, env, env.held_out, {})

    def show(rows):
        return print(_line(rows, chunks), flush=True)

    hooks = driver.Hooks(rows=show) if verbose else driver.Hooks()
    with (
        tempfile.TemporaryDirectory() as temporary,
        numerics(np.float64),
        process.single_blas_thread(),
    ):
        place = Path(folder or temporary)
        place.mkdir(parents=True, exist_ok=True)
        outcome = driver.train(config, env, work.evaluate, place, hooks)
    return work.policy(driver.best_of(outcome.best).actor)


def _line(rows: list[driver.Row], chunks: int) -> str:
    scores = ", ".join(f"{row[driver.SCORE]:.2f}" for row in rows)
    return (
        f"{rows[0]['chunk']}/{chunks}: {rows[0]['env_steps']} steps, iterations on training "
        f"scenes {scores}"
    )


def gym_env(preset: str = "paper", overrides: Sequence[str] = (), **settings: Any) -> GymGame:
    """What `gymnasium.make("jaxba/BundleAdjustment-v0")` makes: one scene at a time. Arguments as
    for `make_env`."""
    from jaxba.game.gym import GymGame

    return GymGame(make_env(preset, *overrides, "envs=1", **settings))


def gym_vector_env(
    num_envs: int = 64,
    preset: str = "paper",
    overrides: Sequence[str] = (),
    autoreset_mode: str = "NextStep",
    **settings: Any,
) -> GymVectorGame:
    """The same for `gymnasium.make_vec`: many scenes in one compiled program.

    Args:
        num_envs: scenes in play.
        preset: as for `make_env`.
        overrides: as for `make_env`.
        autoreset_mode: when the next episode begins: `NextStep`, Gymnasium's default, or
            `SameStep`.
        settings: other arguments of `make_env`.

    Raises: as `make_env`; ValueError: another mode."""
    from jaxba.game.gym import GymVectorGame

    return GymVectorGame(
        make_env(preset, *overrides, f"envs={num_envs}", **settings), autoreset_mode
    )
