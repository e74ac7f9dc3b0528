"""The game as Gymnasium environments, for trainers that speak NumPy. Needs the extra `gym`.

`GymVectorGame` steps all scenes of a `Game` in one compiled call and resets those that ended. `GymGame` is a game of
one scene at a time, which its trainer resets.
"""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from jaxba.damping.features import FEATURE_LIMIT
from jaxba.game.env import Game, GameState
from jaxba.game.protocol import Step
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError:
    raise ImportError("this needs Gymnasium: pip install jaxba[gym]") from None


_reset = jit(lambda game, key: game.reset(key))
_step = jit(lambda game, state, action: game.step(state, action))


@jit
def _reset_some(game: Game, state: GameState, key: Array, chosen: Array) -> tuple[GameState, Array]:
    fresh, _ = game.reset(key)
    merged = game.merged(chosen, fresh, state)
    return merged, game.observations(merged)


@jit
def _step_some(game: Game, state: GameState, action: Array, chosen: Array) -> tuple[GameState, Step]:
    """A step of the chosen environments; the others stay where they are, with no reward and no end."""
    after, step = game.step(state, action)
    after = game.merged(chosen, after, state)
    observation = game.observations(after)
    return after, step._replace(
        observation=observation,
        reward=jnp.where(chosen, step.reward, 0),
        terminated=step.terminated & chosen,
        truncated=step.truncated & chosen,
        final_observation=jnp.where(chosen[:, None], step.final_observation, observation),
    )


class GymVectorGame(gymnasium.vector.VectorEnv):
    """All scenes of a game. What follows the end of an episode is Gymnasium's choice of three:

    - `SAME_STEP`: another episode in the same step. For each episode that ended, `infos` has the last observation in
      `final_obs` and the metrics of the episode in `final_info`: `length`, `success`, `rejections`, and `ceres`, the
      iterations that Ceres' rule takes.
    - `NEXT_STEP`: another episode in the next step, whose action is ignored and whose reward is zero. `infos` has the
      metrics of an episode that ended.
    - `DISABLED`: none, until `reset` is called with `options={"reset_mask": mask}`. `infos` as for `NEXT_STEP`.
    """

    def __init__(self, game: Game, autoreset_mode: AutoresetMode = AutoresetMode.SAME_STEP) -> None:
        """Random numbers are seeded by the operating system until `reset` is given a seed."""
        self.autoreset_mode = AutoresetMode(autoreset_mode)
        self.metadata = {"autoreset_mode": self.autoreset_mode, "render_modes": []}
        self.num_envs = game.num_envs
        limit = FEATURE_LIMIT if game.config.agent.observation == "scale-free" else np.inf
        self._features = game.observation_size - game.privileged_size  # not what only critics see
        self.single_observation_space = spaces.Box(-limit, limit, (self._features,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (game.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._game: Game | None = game
        self._observation: np.ndarray | None = None  # the last one that was returned; None before the first reset
        self._ended = np.zeros(self.num_envs, bool)  # episodes that no other one has followed yet

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New episodes everywhere, or where a mask says so.

        Args:
            seed: of all random numbers from now on; if None, the current sequence continues.
            options: `reset_mask`: which environments get new episodes, a NumPy array of bools; the others stay, and
                their last observations are returned again.
        """
        mask = None if options is None or options.get("reset_mask") is None else self._mask(options["reset_mask"])
        if mask is not None and self._observation is None:
            raise gymnasium.error.ResetNeeded("call reset without a mask before the first one with a mask")
        super().reset(seed=seed)
        game = self._opened()
        with numerics(game.banks[0].initial_cost.dtype, single_blas=False):
            key = jax.random.key(int(self.np_random.integers(2**31)))
            again = _reset(game, key) if mask is None else _reset_some(game, self._state, key, mask)
            self._state, observation = again[0], np.array(again[1][:, : self._features])
        if mask is None:
            mask = np.ones(self.num_envs, bool)
        elif self._observation is not None:
            observation = np.where(mask[:, None], observation, self._observation)
        self._ended = self._ended & ~mask
        self._observation = observation.copy()
        return observation, {}

    def _mask(self, mask: Any) -> np.ndarray:
        if not isinstance(mask, np.ndarray) or mask.dtype != np.bool_:
            raise TypeError(f"reset_mask must be a NumPy array of bools, is {mask!r}")
        if mask.shape != (self.num_envs,) or not mask.any():
            raise ValueError(f"reset_mask must choose some of {self.num_envs} environments, is {mask.tolist()}")
        return mask

    def step(self, actions: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One iteration of every scene.

        Args:
            actions: one row per scene; numbers outside of [-1, 1] are clipped.
        """
        if self._observation is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        disabled = self.autoreset_mode == AutoresetMode.DISABLED
        if disabled and self._ended.any():
            ended = np.flatnonzero(self._ended).tolist()
            raise gymnasium.error.ResetNeeded(f"episodes {ended} have ended: call reset with a reset_mask before step")
        actions = _actions(actions, self.action_space.shape)
        game, same_step = self._opened(), self.autoreset_mode == AutoresetMode.SAME_STEP
        with numerics(game.banks[0].initial_cost.dtype, single_blas=False):
            given = game, self._state, jnp.asarray(actions, jnp.float32)
            self._state, found = _step(*given) if same_step else _step_some(*given, ~self._ended)
            step: Any = jax.tree.map(np.array, found)  # copies, which callers may keep and write to
        done, last = step.terminated | step.truncated, step.final_observation[:, : self._features]
        if same_step:
            observation, infos = step.observation[:, : self._features], _infos(step, last, done)
        else:
            self._ended = done
            observation, infos = last, _metrics(step, done)
        self._observation = observation.copy()
        return observation, step.reward.astype(np.float64), step.terminated, step.truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Releases the memory of the scenes."""
        self._game = self._state = None

    def _opened(self) -> Game:
        if self._game is None:
            raise gymnasium.error.ClosedEnvironmentError("this environment was closed")
        return self._game


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
        self._one = GymVectorGame(game)
        self.observation_space, self.action_space = self._one.single_observation_space, self._one.single_action_space
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
        observation, info = self._one.reset(seed=seed)
        self._running = True
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One iteration.

        Args:
            action: numbers outside of [-1, 1] are clipped.
        """
        if not self._running:
            raise gymnasium.error.ResetNeeded("call reset before step: no episode is under way")
        observation, reward, (terminated,), (truncated,), infos = self._one.step(np.asarray(action)[None])
        self._running = not (terminated or truncated)
        if not self._running:
            observation = infos["final_obs"]
            infos = {name: float(x[0]) for name, x in infos["final_info"].items() if not name.startswith("_")}
        return observation[0], float(reward[0]), bool(terminated), bool(truncated), infos

    def close(self) -> None:
        """Releases the memory of the scenes."""
        self._one.close()


def _actions(action: Any, shape: tuple[int, ...] | None) -> np.ndarray:
    array = np.asarray(action, np.float32)
    if array.shape != shape:
        raise ValueError(f"actions must have shape {shape}, not {array.shape}")
    if not np.isfinite(array).all():
        raise ValueError("actions must be finite")
    return np.clip(array, -1, 1)


def _infos(step: Any, observation: np.ndarray, done: np.ndarray) -> dict[str, Any]:
    """In the form of gymnasium's own vector environments: an array per name, and the mask of its entries as `_name`."""
    if not done.any():
        return {}
    last = np.full(len(done), None, dtype=object)
    for k in np.flatnonzero(done):
        last[k] = observation[k].copy()
    final = {"final_obs": last, "_final_obs": done.copy()}
    return {**final, "final_info": _metrics(step, done), "_final_info": done.copy()}


def _metrics(step: Any, done: np.ndarray) -> dict[str, Any]:
    """The metrics of the episodes that ended, in the same form."""
    found: dict[str, Any] = {}
    for name, values in step.metrics.items() if done.any() else ():
        found[name], found[f"_{name}"] = np.where(done, values, 0), done.copy()
    return found
