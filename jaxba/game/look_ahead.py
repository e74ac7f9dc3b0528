"""One-step look-ahead with rollouts: how much a policy could save, if it knew what every action leads to.

From every state each of some actions is tried, followed by a base policy to the end of the episode, and the action with
the lowest price in all is played. That is never worse than the base policy; and no policy that improves on it in one
step can be better, since this one knows the true price to the end. Source: Bertsekas, Tsitsiklis and Wu 1997, "Rollout
Algorithms for Combinatorial Optimization".
"""

from __future__ import annotations

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.damping.features import observe
from jaxba.damping.learned import AgentPolicy
from jaxba.game.env import Episode, Game
from jaxba.game.random_scenes import SceneClass
from jaxba.game.rollout import step_groups
from jaxba.game.scene_bank import Bank
from jaxba.runtime.jit import jit


class Played(NamedTuple):
    """What an episode came to."""

    paid: Float[Array, ""]
    """Price of its iterations; at least that of as many plain steps as the limit has if it was no success."""

    success: Bool[Array, ""]
    """Whether it came within the game's tolerance of the best known cost."""

    iterations: Int[Array, ""]
    """Its iterations."""


class _Run(NamedTuple):
    episode: Episode
    paid: Array
    success: Array


def play_on(
    game: Game,
    kind: SceneClass,
    bank: Bank,
    policy: AgentPolicy,
    actions: Float[Array, "tries actions"],
    start: Episode,
) -> Float[Array, " tries"]:
    """Price to the end of an episode, if each of some actions is played once and then the policy's.

    Args:
        game: rules; `reward` and bonus play no part.
        kind: class of the bank.
        bank: scenes.
        policy: an agent's, of the same configuration as the game's.
        actions: first actions.
        start: state of the episode.
    """
    advance = _advance(game, kind, bank)
    first = jax.vmap(lambda action: advance(_Run(start, *_nothing(start)), action))

    def body(runs: _Run) -> _Run:
        return step_groups(lambda run: _choose(_ended(game, run), run, advance(run, _action(policy, run))), runs)

    runs = lax.while_loop(lambda runs: ~jnp.all(jax.vmap(lambda run: _ended(game, run))(runs)), body, first(actions))
    return jax.vmap(lambda run: _result(game, run).paid)(runs)


def _nothing(start: Episode) -> tuple[Array, Array]:
    return jnp.zeros_like(start.state.cost), jnp.zeros((), bool)


def _advance(game: Game, kind: SceneClass, bank: Bank):
    """Plays one action and adds its price."""

    def advance(run: _Run, action: Float[Array, " actions"]) -> _Run:
        episode, step = game.iterate(kind, bank, run.episode, action)
        success = step.cost <= bank.best_cost[episode.scene] * (1 + game.config.tolerance)
        return _Run(episode, run.paid + episode.memory.info.prices.of(step).astype(run.paid.dtype), success)

    return advance


def _action(policy: AgentPolicy, run: _Run) -> Float[Array, " actions"]:
    return policy.act(observe(policy.config, run.episode.memory))


def _ended(game: Game, run: _Run) -> Bool[Array, ""]:
    return run.success | (run.episode.memory.guard.iteration >= game.config.max_iterations)


def _choose(condition: Array, if_true: _Run, if_false: _Run) -> _Run:
    return jax.tree.map(lambda a, b: jnp.where(condition, a, b), if_true, if_false)


def _result(game: Game, run: _Run) -> Played:
    iteration = run.episode.memory.guard.iteration
    paid = jnp.where(run.success, run.paid, jnp.maximum(run.paid, game.config.max_iterations))
    return Played(paid, run.success, iteration)


@functools.partial(jit, static_argnames=("number", "looks"))
def _look_ahead(game: Game, number: int, policy: AgentPolicy, actions: Array, looks: bool) -> Played:
    kind, bank = game.kinds[number], game.banks[number]
    advance = _advance(game, kind, bank)

    def one(scene: Int[Array, ""]) -> Played:
        def body(run: _Run) -> _Run:
            own = _action(policy, run)
            if looks:
                tried = jnp.concatenate([own[None], actions.astype(own.dtype)])
                prices = play_on(game, kind, bank, policy, tried, run.episode)
                own = tried[jnp.argmin(prices)]
            return advance(run, own)

        start = game.start(bank, scene)
        return _result(game, lax.while_loop(lambda run: ~_ended(game, run), body, _Run(start, *_nothing(start))))

    return lax.map(one, jnp.arange(bank.initial_cost.shape[0], dtype=jnp.int32))


def look_ahead(
    game: Game, policy: AgentPolicy, actions: Float[np.ndarray, "tries actions"], looks: bool = True
) -> list[Played]:
    """Plays every scene of a game's banks with look-ahead.

    Args:
        game: the banks and the rules.
        policy: the base policy.
        actions: tried in every state, beside the policy's own.
        looks: if False, the policy plays alone.

    Returns:
        One `Played` of NumPy arrays for each bank.
    """
    tried = jnp.asarray(actions, jnp.float32)
    return [
        jax.tree.map(np.asarray, _look_ahead(game, number, policy, tried, looks)) for number in range(len(game.kinds))
    ]
