"""The game as Gymnasium environments, for trainers that speak NumPy. Needs the extra `gym`.

`GymVectorGame` steps all scenes in one compiled call and resets those that ended; `GymGame` has one
scene."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.damping.features import FEATURE_LIMIT
from jaxba.game.env import Game, GameState
from jaxba.game.protocol import Step
from jaxba.runtime.gymnasium_registry import ID, register_game  # noqa: F401 - its name is asked for here
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics

try:
    import gymnasium
    from gymnasium import spaces
    from gymnasium.vector import AutoresetMode
    from gymnasium.vector.utils import batch_space
except ModuleNotFoundError:
    raise ImportError("this needs Gymnasium: pip install jaxba[gym]") from None


register_game()

_reset = jit(lambda game, key: game.reset(key))
_step = jit(lambda game, state, action: game.step(state, action))


@jit
def _step_or_begin(
    game: Game, state: GameState, action: jax.Array, begins: jax.Array
) -> tuple[GameState, Step]:
    """A step where episodes end in their own last observation, and those that begin have their
    first, and no step.

    Args:
        game: the game; its own step begins the next episode where one ended.
        state: before the step.
        action: shape (envs, actions); of no effect where an episode begins.
        begins: environments whose episode ended in the step before, shape (envs,)."""

    def where(old: jax.Array, new: jax.Array) -> jax.Array:
        return jnp.where(begins.reshape(-1, *(1,) * (new.ndim - 1)), old, new)

    after, step = game.step(state, action)
    after = after._replace(episodes=jax.tree.map(where, state.episodes, after.episodes))
    observation = where(game.observations(state), step.final_observation)
    reward = jnp.where(begins, 0, step.reward)
    ends = {"terminated": step.terminated & ~begins, "truncated": step.truncated & ~begins}
    return after, step._replace(observation=observation, reward=reward, **ends)


class GymVectorGame(gymnasium.vector.VectorEnv):
    """All scenes of a game. Where an episode ends, another begins: in the next step, which then
    plays no action, or in the same one.

    For each episode that ended, `infos` has its metrics: `length`, `success`, `rejections`, and
    `ceres`, the iterations that Ceres' rule takes. With resets in the same step they are in
    `final_info`, and the last observation in `final_obs`, as Gymnasium has it."""

    def __init__(
        self, game: Game, autoreset_mode: str | AutoresetMode = AutoresetMode.NEXT_STEP
    ) -> None:
        """Random numbers are seeded by the operating system until `reset` is given a seed.

        `autoreset_mode`: `NextStep`, Gymnasium's default, which its wrappers ask for, or
        `SameStep`. Raises ValueError: another one."""
        modes = (AutoresetMode.NEXT_STEP, AutoresetMode.SAME_STEP)
        if autoreset_mode not in [*modes, *(mode.value for mode in modes)]:
            names = " or ".join(mode.value for mode in modes)
            raise ValueError(
                f"autoreset_mode must be {names}, is "
                f"{getattr(autoreset_mode, 'value', autoreset_mode)}"
            )
        self._next_step = AutoresetMode(autoreset_mode) == AutoresetMode.NEXT_STEP
        self._begins = np.zeros(game.num_envs, bool)  # where an episode ended in the last step
        self.metadata = {"autoreset_mode": AutoresetMode(autoreset_mode), "render_modes": []}
        self.num_envs = game.num_envs
        limit = FEATURE_LIMIT if game.config.agent.observation == "scale-free" else np.inf
        self._features = game.observation_size - game.privileged_size  # not what only critics see
        self.single_observation_space = spaces.Box(-limit, limit, (self._features,), np.float32)
        self.single_action_space = spaces.Box(-1.0, 1.0, (game.action_size,), np.float32)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)
        self._game: Game | None = game
        self._state: GameState | None = None  # before the first reset

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """New episodes everywhere. `seed` is that of all random numbers from now on; if None, the
        current sequence continues. Raises ValueError: options, which are not known."""
        if options:
            raise ValueError(f"reset has no options, is given {', '.join(options)}")
        super().reset(seed=seed)
        game = self._opened()
        self._begins[:] = False
        with numerics(game.bank.initial_cost.dtype, single_blas=False):
            self._state, observation = _reset(
                game, jax.random.key(int(self.np_random.integers(2**31)))
            )
            return np.array(observation[:, : self._features]), {}

    def step(
        self, actions: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, dict[str, Any]]:
        """One iteration of every scene, with a row of `actions` for each; numbers outside of [-1,
        1] are clipped."""
        game = self._opened()
        if self._state is None:
            raise gymnasium.error.ResetNeeded("call reset before step")
        actions = _actions(actions, self.action_space.shape)
        with numerics(game.bank.initial_cost.dtype, single_blas=False):
            chosen = jnp.asarray(actions, jnp.float32)
            if self._next_step:
                self._state, found = _step_or_begin(game, self._state, chosen, self._begins)
            else:
                self._state, found = _step(game, self._state, chosen)
            step: Any = jax.tree.map(np.array, found)  # copies, which callers may keep and write to
        done = step.terminated | step.truncated
        if self._next_step:
            infos = _metrics(step, done)
            self._begins = done.copy()
        else:
            infos = _infos(step, step.final_observation[:, : self._features], done)
        reward = step.reward.astype(np.float64)
        return step.observation[:, : self._features], reward, step.terminated, step.truncated, infos

    def close_extras(self, **kwargs: Any) -> None:
        """Releases the memory of the scenes."""
        self._game = self._state = None

    def _opened(self) -> Game:
        if self._game is None:
            raise gymnasium.error.ClosedEnvironmentError("this environment was closed")
        return self._game


class GymGame(gymnasium.Env):
    """A game of one scene at a time, a random one of the bank in every episode.

    When an episode ends, `info` has the metrics that `GymVectorGame` has."""

    metadata = {"render_modes": []}  # noqa: RUF012 - as gymnasium declares it

    def __init__(self, game: Game) -> None:
        """The game has a single environment."""
        if game.num_envs != 1:
            raise ValueError(
                f"a GymGame needs a game with one environment, this one has {game.num_envs}"
            )
        self._one = GymVectorGame(game, AutoresetMode.SAME_STEP)
        self.observation_space, self.action_space = (
            self._one.single_observation_space,
            self._one.single_action_space,
        )
        self._running = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[np.ndarray, dict[str, Any]]:
        """A new episode. `seed` is of all random numbers from now on; None goes on with the
        sequence."""
        super().reset(seed=seed)
        observation, info = self._one.reset(seed=seed)
        self._running = True
        return observation[0], info

    def step(self, action: np.ndarray) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        """One iteration; numbers of the action outside of [-1, 1] are clipped."""
        if not self._running:
            raise gymnasium.error.ResetNeeded("call reset before step: no episode is under way")
        observation, reward, (terminated,), (truncated,), infos = self._one.step(
            _actions(action, self.action_space.shape)[None]
        )
        self._running = not (terminated or truncated)
        if not self._running:
            observation = infos["final_obs"]
            infos = {
                name: float(x[0])
                for name, x in infos["final_info"].items()
                if not name.startswith("_")
            }
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


def _metrics(step: Step, done: np.ndarray) -> dict[str, Any]:
    """Metrics of the episodes that ended, as gymnasium's own vector environments have them: an
    array per name, and the mask of its entries as `_name`."""
    metrics: dict[str, Any] = {}
    if done.any():
        for name, values in step.metrics.items():
            metrics |= {name: np.where(done, values, 0), f"_{name}": done.copy()}
    return metrics


def _infos(step: Step, observation: np.ndarray, done: np.ndarray) -> dict[str, Any]:
    """The metrics and last observations of the episodes that ended, where others began in the same
    step."""
    if not done.any():
        return {}
    last = np.full(len(done), None, dtype=object)
    for k in np.flatnonzero(done):
        last[k] = observation[k].copy()
    metrics = _metrics(step, done)
    return {
        "final_obs": last,
        "_final_obs": done.copy(),
        "final_info": metrics,
        "_final_info": done.copy(),
    }
