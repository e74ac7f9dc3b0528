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


def observation_space(game: Game) -> spaces.Box:
    """Bounds of one scene's observation."""
    agent = game.config.agent
    limit = FEATURE_LIMIT if agent.observation == "scale-free" else np.inf
    return spaces.Box(-limit, limit, (game.observation_size - game.privileged_size,), np.float32)


def action_space(game: Game) -> spaces.Box:
    """Bounds of one scene's action."""
    return spaces.Box(-1.0, 1.0, (game.action_size,), np.float32)


class _Compiled:
    """`reset` and `step` of a game with NumPy arrays. The game is an argument of the compiled functions, so that its
    banks are not constants in them."""

    def __init__(self, game: Game) -> None:
        self.game = game
        self.dtype = game.banks[0].initial_cost.dtype

    def reset(self, random: np.random.Generator, mask: np.ndarray | None = None) -> np.ndarray:
        """New episodes, where the mask is true if one is given: the first observations of all that are under way."""
        with numerics(self.dtype, single_blas=False):
            key = jax.random.key(int(random.integers(2**31)))
            if mask is None:
                self.state, observation = _reset(self.game, key)
            else:
                self.state, observation = _reset_some(self.game, self.state, key, mask)
            return np.array(self._seen(observation))

    def step(self, action: np.ndarray, waiting: np.ndarray | None = None) -> Any:
        """One iteration of every scene that is not waiting: a `Step` of NumPy arrays."""
        with numerics(self.dtype, single_blas=False):
            given = jnp.asarray(action, jnp.float32)
            if waiting is None:
                self.state, step = _step(self.game, self.state, given)
            else:
                self.state, step = _step_some(self.game, self.state, given, ~waiting)
            step = step._replace(
                observation=self._seen(step.observation), final_observation=self._seen(step.final_observation)
            )
            return jax.tree.map(np.array, step)  # copies, which callers may keep and write to

    def _seen(self, observation: Array) -> Array:
        """Without what only critics see."""
        return observation[:, : self.game.observation_size - self.game.privileged_size]


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
        self.single_observation_space, self.single_action_space = observation_space(game), action_space(game)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._compiled: _Compiled | None = _Compiled(game)
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
        observation = self._game().reset(self.np_random, mask)
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
        if self.autoreset_mode == AutoresetMode.SAME_STEP:
            step = self._game().step(actions)
            done = step.terminated | step.truncated
            observation, infos = step.observation, _infos(step, done)
        else:
            step = self._game().step(actions, self._ended)
            done = self._ended = step.terminated | step.truncated
            observation, infos = step.final_observation, _metrics(step, done)
        self._observation = observation.copy()
        return observation, step.reward.astype(np.float64), step.terminated, step.truncated, infos

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
    for k in np.flatnonzero(done):
        last[k] = step.final_observation[k].copy()
    final = {"final_obs": last, "_final_obs": done.copy()}
    return {**final, "final_info": _metrics(step, done), "_final_info": done.copy()}


def _metrics(step: Any, done: np.ndarray) -> dict[str, Any]:
    """The metrics of the episodes that ended, in the same form."""
    found: dict[str, Any] = {}
    for name, values in step.metrics.items() if done.any() else ():
        found[name], found[f"_{name}"] = np.where(done, values, 0), done.copy()
    return found
