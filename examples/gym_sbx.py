"""Trains sbx's SAC, which knows nothing of jaxba, on the game for a minute, by way of Gymnasium.

    pip install jaxba[gym] sbx-rl
    python examples/gym_sbx.py [--seconds 60] [--envs 32]

Prints iterations per episode at the start and at the end, beside those of Ceres' rule on the same
scenes."""

from __future__ import annotations

import argparse
import sys
import time
from typing import Any

import jax
import numpy as np

try:
    from sbx import SAC
    from stable_baselines3.common.callbacks import BaseCallback
    from stable_baselines3.common.vec_env import VecEnv
except ModuleNotFoundError:
    sys.exit("this example needs sbx, which is no part of jaxba: pip install sbx-rl")

from jaxba import StepOptions
from jaxba.game.env import GameConfig, make_game
from jaxba.game.gym import GymVectorGame
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import BankConfig, make_split


class ForStableBaselines(VecEnv):
    """A Gymnasium vector environment that resets in the same step, in the form that
    Stable-Baselines3 has for it."""

    def __init__(self, envs: GymVectorGame) -> None:
        self.envs = envs
        super().__init__(envs.num_envs, envs.single_observation_space, envs.single_action_space)

    def reset(self) -> np.ndarray:
        seed = next((s for s in self._seeds if s is not None), None)
        self._reset_seeds()
        return self.envs.reset(seed=seed)[0]

    def step_async(self, actions: np.ndarray) -> None:
        self.actions = actions

    def step_wait(self) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[dict[str, Any]]]:
        observation, reward, terminated, truncated, found = self.envs.step(self.actions)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for k in np.flatnonzero(terminated | truncated):
            infos[k] = {
                "terminal_observation": found["final_obs"][k],
                "TimeLimit.truncated": bool(truncated[k]),
                **{
                    name: float(found["final_info"][name][k])
                    for name in ("length", "success", "ceres")
                },
            }
        return observation, reward.astype(np.float32), terminated | truncated, infos

    def close(self) -> None:
        self.envs.close()

    def get_attr(self, attr_name: str, indices: Any = None) -> list[Any]:
        return [getattr(self.envs, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: Any = None) -> None:
        raise TypeError("the environments are one program")

    def env_method(
        self, method_name: str, *args: Any, indices: Any = None, **kwargs: Any
    ) -> list[Any]:
        raise TypeError("the environments are one program")

    def env_is_wrapped(self, wrapper_class: type, indices: Any = None) -> list[bool]:
        return [False] * len(list(self._get_indices(indices)))


class Watch(BaseCallback):
    """Collects the lengths of episodes, and ends training when the time is over."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds = seconds
        self.lengths = []
        self.rule = []

    def _on_training_start(self) -> None:
        self.end = time.perf_counter() + self.seconds

    def _on_step(self) -> bool:
        for info in self.locals["infos"]:
            if "length" in info:
                self.lengths.append(info["length"])
                self.rule.append(info["ceres"])
        return time.perf_counter() < self.end


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument(
        "--seconds", type=float, default=60.0, help="of training, compilation included"
    )
    parser.add_argument("--envs", type=int, default=32, help="scenes in play")
    parser.add_argument(
        "--scenes", type=int, default=400, help="scenes drawn; about a third of them are usable"
    )
    arguments = parser.parse_args()

    kind = SceneClass(5, 20)
    config = GameConfig()
    options = config.agent.step_options(StepOptions())
    print("making scenes", flush=True)
    bank = BankConfig(kind=kind, scenes=arguments.scenes)
    # the game counts in float64, but sbx in float32: the adapter keeps them apart
    with jax.enable_x64(True):
        split = make_split(bank, jax.random.key(0), options, config.max_iterations)
        game = make_game(config, kind, split.train, arguments.envs)
    envs = ForStableBaselines(GymVectorGame(game, "SameStep"))

    watch = Watch(arguments.seconds)
    model = SAC("MlpPolicy", envs, learning_starts=1000, gradient_steps=4, seed=0)
    print(
        f"training on {len(split.train.initial_cost)} scenes for {arguments.seconds:g} s",
        flush=True,
    )
    model.learn(10**9, callback=watch)
    if not watch.lengths:
        sys.exit("not one episode ended: give it more --seconds")
    tenth = max(1, len(watch.lengths) // 10)
    print(f"{model.num_timesteps} iterations, {len(watch.lengths)} episodes")
    print(f"iterations per episode: first tenth {np.mean(watch.lengths[:tenth]):.1f}, ", end="")
    print(
        f"last tenth {np.mean(watch.lengths[-tenth:]):.1f}; Ceres' rule "
        f"{np.mean(watch.rule[-tenth:]):.1f}"
    )


if __name__ == "__main__":
    main()
