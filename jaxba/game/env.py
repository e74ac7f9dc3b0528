"""The game: bundle adjustment as a vectorised environment. A step is one LM iteration of every
scene.

| | |
| --- | --- |
| state | a scene of the bank, its current cameras and points, the agent's memory of the episode |
| observation | `damping.features.observe`; critics also see the distance to the best known cost |
| action | a number in (-1, 1): lambda by `damping.guard.damping_of` |
| terminated | accepted cost within `tolerance` of the best known one, or limit, as in the paper |
| truncated | never |
| reward | `GameConfig.reward` |

Everything is traced once. An episode that ends is followed by one on a random scene of the bank."""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import Memory, begin, duration, observation_size, observe, record
from jaxba.damping.guard import action_of, damping_of
from jaxba.damping.rules import Ceres
from jaxba.game.protocol import Step
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import Bank
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import KINDS, LMState, StepInfo
from jaxba.lm.step import lm_step
from jaxba.problem.options import StepOptions, check_known
from jaxba.runtime.groups import step_groups
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.typing import register_pytree

Reward = Literal["constant", "clock", "reduction", "reversed"]

RewardFunction = Callable[[StepInfo, Array, Array], Array]
"""Of an iteration, the best known cost of the scene, and whether the episode has ended in
success."""

# relative distance to the best known cost that a critic does not distinguish from zero
DISTANCE_FLOOR = 1e-6
# fraction of the bonus lost in an iteration under `reduction`. Source: Belder et al. 2023
BONUS_DECAY = 0.01


@dataclass(frozen=True)
class GameConfig:
    """Rules of the game. Hashable: static in compiled programs."""

    agent: AgentConfig = field(default_factory=AgentConfig)
    """What the agent observes and decides."""

    reward: Reward | RewardFunction = "constant"
    """Of an iteration: a function, or a name. `constant`: -1. `clock`: minus its duration by a
    clock, which varies as measured ones do. `reduction`: zero, and the bonus shrinks with every
    iteration. `reversed`: minus log10 of the cost over the best known cost (the paper's reversed
    roles of state and reward). Bonus and scale are those of a name; a function's number is the
    whole reward."""

    bonus: float = 10.0
    """Added if the episode ends in success. Source: Belder et al. 2023."""

    scale: float = 0.1
    """Factor on every reward, so that returns stay within a few units."""

    tolerance: float = 1e-3
    """Success: accepted cost at most (1 + tolerance) times the best known cost."""

    max_iterations: int = 40
    """Limit of an episode's length."""

    def __post_init__(self) -> None:
        if callable(self.reward):
            _check_reward(self.reward)
        else:
            check_known("reward", self.reward, Reward)
        if not (self.max_iterations >= 1 and self.tolerance > 0 and self.scale > 0):
            raise ValueError("max_iterations, tolerance and scale must be positive")
        if not self.tolerance < 1:
            raise ValueError(
                f"tolerance must be below 1, is {self.tolerance}: starts would be successes"
            )
        if not self.bonus >= 0:
            raise ValueError(f"bonus must not be negative, is {self.bonus}")


def _check_reward(reward: RewardFunction) -> None:
    """Traces a user's reward. Raises ValueError: it cannot be traced, or returns anything but one
    number."""

    def scalar(kind):
        return jax.ShapeDtypeStruct((), kind)

    step = StepInfo._make(scalar(KINDS.get(name, jnp.float32)) for name in StepInfo._fields)
    try:
        found = jax.eval_shape(
            lambda *of: jnp.asarray(reward(*of)), step, scalar(jnp.float32), scalar(bool)
        )
    except Exception as error:
        reason = str(error).partition("\n")[0]
        raise ValueError(
            f"the reward is no function of (step, best, success) that JAX can trace: {reason}"
        ) from error
    if found.shape:
        raise ValueError(f"the reward must be one number, not an array of shape {found.shape}")


class Episode(NamedTuple):
    """One environment."""

    scene: Int[Array, ""]
    state: LMState
    memory: Memory


class GameState(NamedTuple):
    """All environments."""

    episodes: Episode
    key: Array


@register_pytree
@dataclass(frozen=True)
class Game:
    """A batch of environments; satisfies `protocol.Environment`."""

    bank: Bank
    """Scenes to play."""

    kind: SceneClass = field(metadata={"static": True})
    """Class of these."""

    num_envs: int = field(metadata={"static": True})
    """Environments that step together."""

    config: GameConfig = field(metadata={"static": True})
    """Rules."""

    options: StepOptions = field(metadata={"static": True})
    """Of the LM step, those of the agent's configuration included (`AgentConfig.step_options`)."""

    @property
    def observation_size(self) -> int:
        """Features of an observation, with the distance to the best known cost."""
        return observation_size(self.config.agent) + self.privileged_size

    @property
    def privileged_size(self) -> int:
        """Features that only critics see: the distance to the best known cost."""
        return 1

    @property
    def action_size(self) -> int:
        """Numbers of an action."""
        return 1

    @for_traces
    def reset(self, key: Array) -> tuple[GameState, Float[Array, "envs features"]]:
        """New episodes everywhere."""
        check_x64(self.bank.initial_cost.dtype)
        key, own = jax.random.split(key)
        episodes = jax.vmap(functools.partial(self._fresh, self.bank))(
            jax.random.split(own, self.num_envs)
        )
        state = GameState(episodes, key)
        return state, self.observations(state)

    def observations(self, state: GameState) -> Float[Array, "envs features"]:
        """What is observed everywhere, for the next actions."""
        return jax.vmap(functools.partial(self._observe, self.bank))(state.episodes)

    def _observe(self, bank: Bank, episode: Episode) -> Float[Array, " features"]:
        distance = episode.state.cost / bank.best_cost[episode.scene] - 1
        decades = jnp.log10(jnp.maximum(distance, DISTANCE_FLOOR)) / -math.log10(DISTANCE_FLOOR)
        seen = observe(self.config.agent, episode.memory)
        return jnp.concatenate([seen, decades[None].astype(seen.dtype)])

    def _fresh(self, bank: Bank, key: Array) -> Episode:
        count = bank.initial_cost.shape[0]
        return self.start(bank, jax.random.randint(key, (), 0, count, jnp.int32))

    def start(self, bank: Bank, scene: Int[Array, ""]) -> Episode:
        """The episode of one scene before its first iteration."""
        scenes, initial, info = jax.tree.map(
            lambda x: x[scene], (bank.scenes, bank.initial_cost, bank.info)
        )
        info = info._replace(max_iterations=jnp.asarray(self.config.max_iterations, jnp.int32))
        state = LMState(scenes.cameras, scenes.points, initial)
        return Episode(scene, state, begin(self.config.agent, info))

    def iterate(
        self, bank: Bank, episode: Episode, action: Float[Array, " actions"]
    ) -> tuple[Episode, StepInfo]:
        """One LM iteration of one scene."""
        agent = self.config.agent
        memory = episode.memory
        layout = class_layout(self.kind, self.options)
        layout = with_scene(
            layout, bank.scenes.pixels[episode.scene], bank.scenes.mask[episode.scene]
        )
        damping = damping_of(agent, memory.guard, action[0])
        state, step = lm_step(
            layout, episode.state, damping, self.options, agent.min_gain, memory.iteration
        )
        return Episode(episode.scene, state, record(agent, memory, step)), step

    @for_traces
    def step(
        self, state: GameState, action: Float[Array, "envs actions"]
    ) -> tuple[GameState, Step]:
        """Plays one action everywhere. Raises ValueError: actions of another shape."""
        check_x64(self.bank.initial_cost.dtype)
        if (expected := (self.num_envs, self.action_size)) != (shape := jnp.shape(action)):
            raise ValueError(f"actions must have shape {expected}, not {shape}")
        key, own = jax.random.split(state.key)
        keys = jax.random.split(own, self.num_envs)
        episodes, step = step_groups(self._play, state.episodes, action, keys, shared=self.bank)
        return GameState(episodes, key), step

    def _play(
        self, bank: Bank, episode: Episode, action: Array, key: Array
    ) -> tuple[Episode, Step]:
        rules = self.config
        best = bank.best_cost[episode.scene]
        after, step = self.iterate(bank, episode, action)
        success = step.cost <= best * (1 + rules.tolerance)
        terminated = success | (after.memory.iteration >= rules.max_iterations)
        reward = self._reward(step, after.memory, best, success)
        fresh = self._fresh(bank, key)
        following = jax.tree.map(lambda new, old: jnp.where(terminated, new, old), fresh, after)

        def single(x):
            return jnp.asarray(x, jnp.float32)

        metrics = {
            "length": single(after.memory.iteration),
            "success": single(success),
            "rejections": single(after.memory.guard.rescue.rejections),
            "ceres": single(
                jnp.minimum(bank.ceres_iterations[episode.scene], rules.max_iterations)
            ),
        }
        observed = functools.partial(self._observe, bank)
        never = jnp.zeros_like(terminated)
        return following, Step(
            observed(following), single(reward), terminated, never, observed(after), metrics
        )

    def _reward(
        self, step: StepInfo, memory: Memory, best: Array, success: Bool[Array, ""]
    ) -> Array:
        rules = self.config
        bonus = jnp.where(success, rules.bonus, 0.0)
        if callable(rules.reward):
            return jnp.asarray(rules.reward(step, best, success))
        if rules.reward == "constant":
            reward = bonus - 1
        elif rules.reward == "clock":
            reward = bonus - duration(step)
        elif rules.reward == "reduction":
            reward = bonus * jnp.maximum(0.0, 1 - BONUS_DECAY * (memory.iteration - 1))
        else:
            reward = bonus - jnp.log10(step.cost / best)
        return rules.scale * reward

    @for_traces
    def demonstrate(self, state: GameState, key: Array) -> Float[Array, "envs actions"]:
        """Uniform actions in half of the environments; Ceres' rule in a quarter, a hundredth of it
        in the last one."""
        agent = self.config.agent
        uniform = jax.random.uniform(
            key, (self.num_envs, self.action_size), minval=-1.0, maxval=1.0
        )
        rule = jax.vmap(_rule_damping)(state.episodes.memory) - 2.0 * (
            jnp.arange(self.num_envs) % 4 == 3
        )
        action = jax.vmap(lambda decades: action_of(agent, decades))(rule)
        action = jnp.clip(action, -0.99, 0.99).astype(jnp.float32)
        return uniform.at[1::2, 0].set(action[1::2])


def _rule_damping(memory: Memory) -> Array:
    """log10 of the lambda that Ceres' rule would use next."""
    rule = Ceres()
    rejections = memory.guard.rescue.in_a_row
    factor = rule.factor(rejections == 0, memory.gain, rule.reject_growth * 2.0 ** (rejections - 1))
    return memory.damping + jnp.where(memory.iteration == 0, 0.0, jnp.log10(factor))


def make_game(
    config: GameConfig,
    kind: SceneClass,
    bank: Bank,
    num_envs: int,
    options: StepOptions | None = None,
) -> Game:
    """A game on a bank of scenes of the class `kind`, with the rules of `config` and so many
    environments. The agent's configuration overrides the `options` of the LM step
    (`AgentConfig.step_options`)."""
    options = config.agent.step_options(options or StepOptions())
    class_layout(kind, options)  # cached on the host before anything is traced
    return Game(bank, kind, num_envs, config, options)
