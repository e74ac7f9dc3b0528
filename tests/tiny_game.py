"""A game small enough to compile in seconds, shared by the tests of the environment and of its
Gymnasium adapter."""

from __future__ import annotations

import functools

import jax
import numpy as np

from jaxba import BundleProblem, StepOptions
from jaxba.damping.agent_config import AgentConfig
from jaxba.game.env import Game, GameConfig, make_game
from jaxba.game.random_scenes import SceneClass, Scenes, make_scenes
from jaxba.game.scene_bank import Bank, select, solve_scenes

KIND = SceneClass(4, 12)
AGENT = AgentConfig(history=2, low=-10.0, high=2.0, first_low=-10.0, descent=50.0)
RULES = GameConfig(agent=AGENT, max_iterations=4)


@functools.cache
def tiny_bank() -> Bank:
    """A dozen scenes or more, with the best costs that Ceres' and GTSAM's rules find."""
    key = jax.random.key(5)
    return select(
        *solve_scenes(KIND, make_scenes(KIND, key, 120), StepOptions(), 40, rules=("ceres",))
    )


def tiny_game(config: GameConfig = RULES, envs: int = 6) -> Game:
    """A game on them."""
    return make_game(config, KIND, tiny_bank(), envs)


def grid(kind: SceneClass, scenes: Scenes) -> np.ndarray:
    """Which camera sees which point, a matrix per scene, without the empty point."""
    return np.asarray(scenes.mask).reshape(-1, kind.cameras, kind.points + 1)[:, :, :-1]


def problem_of(kind: SceneClass, scenes: Scenes, k: int) -> BundleProblem:
    """One scene on the host."""
    seen = grid(kind, scenes)[k]
    pixels = np.asarray(scenes.pixels[k]).reshape(2, kind.cameras, kind.points + 1)[:, :, :-1]
    camera, point = np.nonzero(seen)
    return BundleProblem.create(
        np.asarray(scenes.cameras[k]).T,
        np.asarray(scenes.points[k]).T[:-1],
        pixels[:, camera, point].T,
        camera,
        point,
    )
