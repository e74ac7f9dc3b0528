"""One-step look-ahead with rollouts: how much a policy could save, if it knew what every action leads to.

From every state each of some actions is tried, followed by a base policy to the end of the episode, and the action with
the fewest iterations in all is played. That is never worse than the base policy; and no policy that improves on it in
one step can be better, since this one knows the true number to the end. Source: Bertsekas, Tsitsiklis and Wu 1997,
"Rollout Algorithms for Combinatorial Optimization".
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
    """An episode that is played to its end."""

    episode: Episode
    success: Bool[Array, ""]  # whether it came within the game's tolerance of the best known cost

    @property
    def iterations(self) -> Int[Array, ""]:
        """Its iterations; the game's limit if it was no success."""
        return self.episode.memory.iteration


def play_on(
    game: Game,
    kind: SceneClass,
    bank: Bank,
    policy: AgentPolicy,
    actions: Float[Array, "tries actions"],
    start: Episode,
) -> Int[Array, " tries"]:
    """Iterations of an episode to its end, if each of some actions is played once and then the policy's.

    Args:
        game: rules; `reward` and bonus play no part.
        kind: class of the bank.
        bank: scenes.
        policy: an agent's, of the same configuration as the game's.
        actions: first actions.
        start: state of the episode.
    """
    advance = functools.partial(_advance, game, kind, bank)
    first = jax.vmap(lambda action: advance(Played(start, jnp.zeros((), bool)), action))

    def turn(run: Played) -> Played:
        after = advance(run, _action(policy, run))
        return jax.tree.map(lambda old, new: jnp.where(_ended(game, run), old, new), run, after)

    under_way = lambda runs: ~jnp.all(jax.vmap(functools.partial(_ended, game))(runs))
    return lax.while_loop(under_way, lambda runs: step_groups(turn, runs), first(actions)).iterations


def _advance(game: Game, kind: SceneClass, bank: Bank, run: Played, action: Float[Array, " actions"]) -> Played:
    episode, step = game.iterate(kind, bank, run.episode, action)
    return Played(episode, step.cost <= bank.best_cost[episode.scene] * (1 + game.config.tolerance))


def _action(policy: AgentPolicy, run: Played) -> Float[Array, " actions"]:
    return policy.act(observe(policy.config, run.episode.memory))


def _ended(game: Game, run: Played) -> Bool[Array, ""]:
    return run.success | (run.iterations >= game.config.max_iterations)


@functools.partial(jit, static_argnames=("number", "looks"))
def _look_ahead(game: Game, number: int, policy: AgentPolicy, actions: Array, looks: bool) -> tuple[Array, Array]:
    kind, bank = game.kinds[number], game.banks[number]

    def one(scene: Int[Array, ""]) -> tuple[Array, Array]:
        def body(run: Played) -> Played:
            own = _action(policy, run)
            if looks:
                tried = jnp.concatenate([own[None], actions.astype(own.dtype)])
                own = tried[jnp.argmin(play_on(game, kind, bank, policy, tried, run.episode))]
            return _advance(game, kind, bank, run, own)

        start = Played(game.start(bank, scene), jnp.zeros((), bool))
        end = lax.while_loop(lambda run: ~_ended(game, run), body, start)
        return end.iterations, end.success

    return lax.map(one, jnp.arange(bank.initial_cost.shape[0], dtype=jnp.int32))


def look_ahead(
    game: Game, policy: AgentPolicy, actions: Float[np.ndarray, "tries actions"], looks: bool = True
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Plays every scene of a game's banks with look-ahead.

    Args:
        game: the banks and the rules.
        policy: the base policy.
        actions: tried in every state, beside the policy's own.
        looks: if False, the policy plays alone.

    Returns:
        Iterations of every scene and whether it was solved, for each bank.
    """
    tried = jnp.asarray(actions, jnp.float32)
    return [
        jax.tree.map(np.asarray, _look_ahead(game, number, policy, tried, looks)) for number in range(len(game.kinds))
    ]
