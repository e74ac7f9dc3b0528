"""The game as Gymnasium environments, for trainers that speak NumPy. Needs the extra `gym`.

`GymVectorGame` steps all scenes of a `Game` in one compiled call and resets those that ended in the same step.
`GymGame` is a game of one scene at a time, which its trainer resets.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping.features import FEATURE_LIMIT
from jaxba.game.env import Game

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError:
    raise ImportError("this needs Gymnasium: pip install jaxba[gym]") from None


def observation_space(game: Game) -> spaces.Box:
    """Bounds of one scene's observation."""
    agent = game.config.agent
    limit = FEATURE_LIMIT if agent.observation == "scale-free" else np.inf
    return spaces.Box(-limit, limit, (game.observation_size,), np.float32)


def action_space(game: Game) -> spaces.Box:
    """Bounds of one scene's action."""
    return spaces.Box(-1.0, 1.0, (game.action_size,), np.float32)


class _Compiled:
    """`reset` and `step` of a game with NumPy arrays. The game is an argument of the compiled functions, so that its
    banks are not constants in them."""

    def __init__(self, game: Game) -> None:
        self.game = game
        self.x64 = game.banks[0].initial_cost.dtype == np.float64

    def reset(self, random: np.random.Generator) -> np.ndarray:
        """First observations of new episodes."""
        with jax.enable_x64(self.x64):
            key = jax.random.key(int(random.integers(2**31)))
            self.state, observation = _reset(self.game, key)
            return np.array(observation)

    def step(self, action: np.ndarray) -> Any:
        """One iteration of every scene: a `Step` of NumPy arrays."""
        with jax.enable_x64(self.x64):
            self.state, step = _step(self.game, self.state, jnp.asarray(action, jnp.float32))
            return jax.tree.map(np.array, step)  # copies, which callers may keep and write to


_reset = jax.jit(lambda game, key: game.reset(key))
_step = jax.jit(lambda game, state, action: game.step(state, action))


class GymVectorGame(gymnasium.vector.VectorEnv):
    """All scenes of a game. An episode that ends is followed by another one in the same step.

    For each episode that ended, `infos` has the last observation in `final_obs` and the metrics of the episode in
    `final_info`: `length`, `success`, `rejections`, and `ceres`, the iterations that Ceres' rule takes.
    """

    def __init__(self, game: Game) -> None:
        """Random numbers are seeded by the operating system until `reset` is given a seed."""
        self.metadata = {"autoreset_mode": AutoresetMode.SAME_STEP, "render_modes": []}
        self.num_envs = game.num_envs
        self.single_observation_space, self.single_action_space = observation_space(game), action_space(game)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._compiled: _Compiled | None = _Compiled(game)
        self._started = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New episodes everywhere.

        Args:
            seed: of all random numbers from now on; if None, the current sequence continues.
            options: not used.
        """
        super().reset(seed=seed)
        observation = self._game().reset(self.np_random)
        self._started = True
        return observation, {}

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One iteration of every scene.

        Args:
            actions: one row per scene; numbers outside of [-1, 1] are clipped.
        """
        if not self._started:
            raise gymnasium.error.ResetNeeded("call reset before step")
        step = self._game().step(_actions(actions, self.action_space.shape))
        done = step.terminated | step.truncated
        return step.observation, step.reward.astype(np.float64), step.terminated, step.truncated, _infos(step, done)

    def close_extras(self, **kwargs: Any) -> None:
        """Releases the memory of the scenes."""
        self._compiled = None

    def _game(self) -> _Compiled:
        return _open(self._compiled)


class GymGame(gymnasium.Env):
    """A game of one scene at a time, a random one of the bank in every episode.

    When an episode ends, `info` has the metrics that `GymVectorGame` has in `final_info`.
    """

    metadata = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    def __init__(self, game: Game) -> None:
        """
        Args:
            game: with a single environment.
        """
        if game.num_envs != 1:
            raise ValueError(f"a GymGame needs a game with one environment, this one has {game.num_envs}")
        self.observation_space, self.action_space = observation_space(game), action_space(game)
        self._compiled: _Compiled | None = _Compiled(game)
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode.

        Args:
            seed: of all random numbers from now on; if None, the current sequence continues.
            options: not used.
        """
        super().reset(seed=seed)
        observation = self._game().reset(self.np_random)[0]
        self._running = True
        return observation, {}

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One iteration.

        Args:
            action: numbers outside of [-1, 1] are clipped.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("call reset before step: no episode is under way")
        step = self._game().step(_actions(action, self.action_space.shape)[None])
        terminated, truncated = bool(step.terminated[0]), bool(step.truncated[0])
        self._running = not (terminated or truncated)
        info = {} if self._running else {name: float(values[0]) for name, values in step.metrics.items()}
        return step.final_observation[0], float(step.reward[0]), terminated, truncated, info

    def close(self) -> None:
        """Releases the memory of the scenes."""
        self._compiled = None

    def _game(self) -> _Compiled:
        return _open(self._compiled)


def _open(compiled: _Compiled | None) -> _Compiled:
    if compiled is None:
        raise gymnasium.error.ClosedEnvironmentError("this environment was closed")
    return compiled


def _actions(action: Any, shape: tuple[int, ...] | None) -> np.ndarray:
    array = np.asarray(action, np.float32)
    if array.shape != shape:
        raise ValueError(f"actions must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("actions must be finite")
    return np.clip(array, -1, 1)


def _infos(step: Any, done: np.ndarray) -> dict[str, Any]:
    """In the form of gymnasium's own vector environments: an array per name, and the mask of its entries as `_name`."""
    if not done.any():
        return {}
    last = np.full(len(done), None, dtype=object)
    metrics: dict[str, np.ndarray] = {}
    for k in np.flatnonzero(done):
        last[k] = step.final_observation[k].copy()
    for name, values in step.metrics.items():
        metrics[name], metrics[f"_{name}"] = np.where(done, values, 0), done.copy()
    return {"final_obs": last, "_final_obs": done.copy(), "final_info": metrics, "_final_info": done.copy()}
