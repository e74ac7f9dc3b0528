"""How far a game could be won: the look-ahead with rollouts beside the best constant action and a trained policy.

    python -m benchmarks.look_ahead RUN [--scenes 64]

RUN is a folder of `jaxba-train`. The best constant action is searched on its training scenes. The first of its held-out
scenes are then played by that action, by the trained policy, and by a look-ahead with either as its base. Printed are
geometric means of the iterations, and their paired ratios to the constant action's with 95% intervals.

The look-ahead tries each of some lambdas from every state, followed by the base policy to the end of the episode, and
plays the one with the fewest iterations in all. That is never worse than the base policy; and no policy that improves
on it in one step can be better, since this one knows the true number to the end. Source: Bertsekas, Tsitsiklis and Wu
1997, "Rollout Algorithms for Combinatorial Optimization".
"""

from __future__ import annotations

import functools
import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.cli.common import prepare_process
from jaxba.damping.features import observe
from jaxba.damping.learned import AgentPolicy
from jaxba.damping.policy_file import load_policy
from jaxba.game.env import Episode, Game, make_game
from jaxba.game.evaluate import best_constant_action
from jaxba.game.groups import step_groups
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import Bank, select
from jaxba.game.statistics import paired_ratio
from jaxba.runtime import process
from jaxba.training.config import load
from jaxba.training.task import BANK, first_scenes, read_banks

LAMBDAS = (-1.0, -0.6, -0.2, 0.2, 0.6)
"""Actions that are tried."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    run: Annotated[Path, tyro.conf.Positional]
    """Folder of the training."""

    scenes: int = 64
    """Held-out scenes of each class."""


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


@functools.partial(jax.jit, static_argnames=("number", "looks"))
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


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark."""
    args = tyro.cli(Arguments, args=argv)
    jax.config.update("jax_enable_x64", True)
    prepare_process()
    config, splits = load(str(args.run / "config.yaml")), read_banks(args.run / BANK)
    rules, kinds = config.game, config.bank.classes
    options = rules.agent.step_options(config.step_options)
    with process.single_blas_thread():
        training, held_out = ([getattr(split, part) for split in splits] for part in ("train", "held_out"))
        limits = rules.tolerance, rules.max_iterations
        constant = best_constant_action(kinds, first_scenes(training, held_out), rules.agent, options, *limits)
        print(f"best constant action: {constant.action[0]:.2f}")
        few = [select(bank, np.arange(min(args.scenes, len(bank.initial_cost)))) for bank in held_out]
        game = make_game(rules, kinds, few, config.envs, config.step_options)
        actions = np.array(LAMBDAS)[:, None]
        policies = {"constant action": constant, "learned": load_policy(args.run / "policy.safetensors")}
        taken: dict[str, np.ndarray] = {}
        for (name, policy), looks in itertools.product(policies.items(), (False, True)):
            started, label = time.perf_counter(), f"look-ahead from {name}" if looks else name
            played = look_ahead(game, policy, actions, looks)
            taken[label] = np.concatenate([iterations for iterations, _ in played])
            failures = 1 - np.mean(np.concatenate([success for _, success in played]))
            mean, ratio = np.exp(np.log(taken[label]).mean()), paired_ratio(taken[label], taken["constant action"])
            interval = "{:.3f} [{:.3f}, {:.3f}]".format(*ratio)
            seconds = time.perf_counter() - started
            print(f"{label:30} {mean:.3f} iterations, {interval}, {failures:.1%} never ({seconds:.0f} s)", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
