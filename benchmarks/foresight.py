"""What λ is worth: foresight, the best λ that can be predicted, and one constant λ, over the same
scenes.

    python -m benchmarks.foresight [--steps plain embedded] [--problems FILE ...] [--scenes 900]
    [--out FILE]

The base is the constant action with the fewest iterations on the training scenes. From every state
of its episodes, in which some actions are drawn at random, each of a grid of lambdas is tried once
and followed by the base to the true end. These exact numbers say three things:

- `foresight`: held-out scenes played by a look-ahead that knows them, and takes the best one in
  every state (Bertsekas, Tsitsiklis and Wu 1997, "Rollout Algorithms for Combinatorial
  Optimization").
- `R2`: how much of an action's advantage over the base's, log(iterations / iterations of the base),
  a network predicts from what an agent observes, on training scenes that it was not fitted to; the
  largest over the actions.
- `predicted`: held-out scenes played by the policy that takes the action of the best predicted
  advantage, or the base's unless it promises more than a margin, which is chosen on the training
  scenes.

Ratios are geometric means of iterations over those of the base, scene by scene, with 95% intervals.
Scenes are random ones, or with `--problems` windows of real problems. A row takes five to fifteen
minutes on two cores."""

from __future__ import annotations

import functools
import itertools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import optax
import tyro
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.cli.common import prepare_process
from jaxba.damping.agent_config import AgentConfig, embedded
from jaxba.damping.features import observe
from jaxba.damping.guard import action_of
from jaxba.damping.learned import AgentPolicy, LearnedPolicy, always
from jaxba.game.env import Episode, Game, GameConfig, make_game
from jaxba.game.evaluate import best_constant_action
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import Bank, BankConfig, make_split
from jaxba.game.statistics import paired_ratio
from jaxba.runtime import process
from jaxba.runtime.groups import step_groups
from jaxba.typing import register_pytree

DECADES = (-9.0, -8.0, -7.0, -6.0, -5.0, -4.0, -3.0, -2.0, -1.0, 0.0)
"""log10 of the lambdas that are tried from a state, beside the base's own."""

FREE = {"first_low": -9.0, "descent": 11.0}
"""Limits of the guard that leave lambda free: what is asked here is what it is worth, not what a
limit costs."""

STATES = 12
"""States of an episode that are looked at."""

EXPLORED = 0.3
"""Share of the base's actions that are drawn at random instead, so that states off its path are
seen, too."""

MARGINS = (0.0, 0.02, 0.05, 0.1, 0.15, 0.2, 0.3)
"""Of a predicted advantage, in logarithms."""

FOLDS = 5
WIDTH = 96
EPOCHS = 80
BATCH = 256
"""Of the networks: folds of the scenes, one network each; units of each of two hidden layers;
training."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    steps: tuple[Literal["plain", "embedded"], ...] = ("plain", "embedded")
    """Steps of the game."""

    problems: tuple[Path, ...] = ()
    """Real problems, of which windows of 10 cameras are cut. Default: random scenes."""

    scenes: int = 900
    """Scenes drawn; a tenth is held out."""

    seed: int = 0
    """Of everything."""

    out: Path | None = None
    """Where the table is written, too."""


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
    bank: Bank,
    policy: AgentPolicy,
    actions: Float[Array, "tries actions"],
    start: Episode,
) -> Int[Array, " tries"]:
    """Iterations of an episode to its end, if each of some actions is played once and then the
    policy's.

    Args:
        game: rules; `reward` and bonus play no part.
        bank: scenes.
        policy: an agent's, of the same configuration as the game's.
        actions: first actions.
        start: state of the episode.
    """
    advance = functools.partial(_advance, game, bank)
    first = jax.vmap(lambda action: advance(Played(start, jnp.zeros((), bool)), action))

    def turn(run: Played) -> Played:
        after = advance(run, _action(policy, run))
        return jax.tree.map(lambda old, new: jnp.where(_ended(game, run), old, new), run, after)

    def under_way(runs):
        return ~jnp.all(jax.vmap(functools.partial(_ended, game))(runs))

    return lax.while_loop(
        under_way, lambda runs: step_groups(turn, runs), first(actions)
    ).iterations


def _advance(game: Game, bank: Bank, run: Played, action: Float[Array, " actions"]) -> Played:
    episode, step = game.iterate(bank, run.episode, action)
    return Played(episode, step.cost <= bank.best_cost[episode.scene] * (1 + game.config.tolerance))


def _action(policy: AgentPolicy, run: Played) -> Float[Array, " actions"]:
    return policy.act(observe(policy.config, run.episode.memory))


def _ended(game: Game, run: Played) -> Bool[Array, ""]:
    return run.success | (run.iterations >= game.config.max_iterations)


@functools.partial(jax.jit, static_argnames=("looks",))
def _look_ahead(
    game: Game, policy: AgentPolicy, actions: Array, looks: bool
) -> tuple[Array, Array]:
    bank = game.bank

    def one(scene: Int[Array, ""]) -> tuple[Array, Array]:
        def body(run: Played) -> Played:
            own = _action(policy, run)
            if looks:
                tried = jnp.concatenate([own[None], actions.astype(own.dtype)])
                own = tried[jnp.argmin(play_on(game, bank, policy, tried, run.episode))]
            return _advance(game, bank, run, own)

        start = Played(game.start(bank, scene), jnp.zeros((), bool))
        end = lax.while_loop(lambda run: ~_ended(game, run), body, start)
        return end.iterations, end.success

    return lax.map(one, jnp.arange(bank.initial_cost.shape[0], dtype=jnp.int32))


def look_ahead(
    game: Game, policy: AgentPolicy, actions: Float[np.ndarray, "tries actions"], looks: bool = True
) -> tuple[np.ndarray, np.ndarray]:
    """Plays every scene of a game's bank with look-ahead.

    Args:
        game: the bank and the rules.
        policy: the base policy.
        actions: tried in every state, beside the policy's own.
        looks: if False, the policy plays alone.

    Returns:
        Iterations of every scene and whether it was solved.
    """
    tried = jnp.asarray(actions, jnp.float32)
    return jax.tree.map(np.asarray, _look_ahead(game, policy, tried, looks))


class Labels(NamedTuple):
    """States of episodes, and what each first action leads to."""

    seen: Any  # (states, features), as an agent observes
    iterations: Any  # (states, 1 + actions) to the end, the base's own action first
    scene: Any  # (states,)


@jax.jit
def _collect(game: Game, policy: AgentPolicy, actions: Array, key: Array) -> tuple[Array, ...]:
    bank = game.bank

    def one(scene: Int[Array, ""]) -> tuple[Array, ...]:
        def body(run: Played, key: Array) -> tuple[Played, tuple[Array, ...]]:
            alive = ~_ended(game, run)
            tried = jnp.concatenate([_action(policy, run)[None], actions.astype(jnp.float32)])
            taken = lax.cond(
                alive,
                lambda episode: play_on(game, bank, policy, tried, episode),
                lambda _: jnp.zeros(tried.shape[0], run.iterations.dtype),
                run.episode,
            )
            explores, which = jax.random.split(key)
            drawn = jax.random.randint(which, (), 0, tried.shape[0])
            pick = jnp.where(jax.random.bernoulli(explores, EXPLORED), drawn, 0)
            after = _advance(game, bank, run, tried[pick])
            after = jax.tree.map(lambda new, old: jnp.where(alive, new, old), after, run)
            left = taken - run.iterations
            return after, (alive, observe(policy.config, run.episode.memory), left)

        start = Played(game.start(bank, scene), jnp.zeros((), bool))
        return lax.scan(body, start, jax.random.split(jax.random.fold_in(key, scene), STATES))[1]

    return lax.map(one, jnp.arange(bank.initial_cost.shape[0], dtype=jnp.int32))


def collect(
    game: Game, policy: AgentPolicy, actions: Float[np.ndarray, "tries actions"], seed: int
) -> Labels:
    """Exact labels of the states of the base's episodes on the bank of a game."""
    found = _collect(game, policy, jnp.asarray(actions, jnp.float32), jax.random.key(seed))
    alive, seen, left = (np.asarray(x) for x in found)
    scene = np.broadcast_to(np.arange(len(alive))[:, None], alive.shape)
    return Labels(seen[alive], np.maximum(left[alive], 1), scene[alive])


Network = list[tuple[Array, Array]]


def _outputs(network: Any, x: Array) -> Array:
    for kernel, bias in network[:-1]:
        x = jax.nn.relu(x @ kernel + bias)
    return x @ network[-1][0] + network[-1][1]


@jax.jit
def _fitted(key: Array, x: Array, y: Array, held: Array, truth: Array) -> Network:
    """A network fitted to rows; of all epochs the one with the smallest error on other rows."""
    sizes = (x.shape[1], WIDTH, WIDTH, y.shape[1])
    shapes = list(itertools.pairwise(sizes))
    network = [
        (
            jax.random.normal(k, shape, jnp.float32) * (2 / shape[0]) ** 0.5,
            jnp.zeros(shape[1], jnp.float32),
        )
        for k, shape in zip(jax.random.split(key, len(shapes)), shapes, strict=True)
    ]
    steps = max(1, len(x) // BATCH)
    rule = optax.adamw(optax.cosine_decay_schedule(2e-3, EPOCHS * steps), weight_decay=1e-3)

    def loss(network, x, y):
        return jnp.mean(optax.huber_loss(_outputs(network, x), y, delta=0.5))

    def epoch(carry: Any, key: Array) -> tuple[Any, None]:
        network, state, best, least = carry
        rows = jax.random.permutation(key, len(x))[: steps * BATCH].reshape(steps, -1)

        def update(carry: Any, rows: Array) -> tuple[Any, None]:
            network, state = carry
            updates, state = rule.update(jax.grad(loss)(network, x[rows], y[rows]), state, network)
            return (optax.apply_updates(network, updates), state), None

        network, state = lax.scan(update, (network, state), rows)[0]
        error = jnp.mean((_outputs(network, held) - truth) ** 2)
        best = jax.tree.map(lambda new, old: jnp.where(error < least, new, old), network, best)
        return (network, state, best, jnp.minimum(error, least)), None

    start = (network, rule.init(network), network, jnp.float32(jnp.inf))
    return lax.scan(epoch, start, jax.random.split(key, EPOCHS))[0][2]


@register_pytree
@dataclass(frozen=True)
class Predicted(AgentPolicy):
    """The action of the best predicted advantage; the base's own unless that is above a margin."""

    networks: Any  # stacked, one for each fold
    mean: Array
    scale: Array
    actions: Array
    margin: Array
    config: AgentConfig = field(metadata={"static": True})

    def act(self, observation: Float[Array, " features"]) -> Float[Array, " actions"]:
        """See `AgentPolicy`."""
        scaled = (observation - self.mean) / self.scale
        change = jax.vmap(_outputs, (0, None))(self.networks, scaled).mean(axis=0).at[0].set(0.0)
        best = jnp.argmin(change)
        return self.actions[jnp.where(change[best] < -self.margin, best, 0)]


def fit(
    labels: Labels, base: LearnedPolicy, actions: Float[np.ndarray, "tries actions"], seed: int
) -> Any:
    """The policy of the predicted advantages, and R2 of each action's on the scenes of the other
    folds."""
    x = labels.seen
    change = np.log(labels.iterations / labels.iterations[:, :1]).astype(np.float32)
    mean = x.mean(axis=0)
    scale = x.std(axis=0) + 1e-3
    x = ((x - mean) / scale).astype(np.float32)
    fold = np.random.default_rng(seed).permutation(labels.scene.max() + 1)[labels.scene] % FOLDS
    networks = []
    beyond = np.zeros_like(change)
    for number in range(FOLDS):
        held = fold == number
        key = jax.random.fold_in(jax.random.key(seed), number)

        # rows repeated to one size, so that all folds share a program
        def pad(rows, size):
            return jnp.asarray(rows[np.arange(size) % len(rows)])

        sizes = (
            max((fold != k).sum() for k in range(FOLDS)),
            max((fold == k).sum() for k in range(FOLDS)),
        )
        parts = (
            pad(x[~held], sizes[0]),
            pad(change[~held], sizes[0]),
            pad(x[held], sizes[1]),
            pad(change[held], sizes[1]),
        )
        networks.append(_fitted(key, *parts))
        beyond[held] = _outputs(networks[-1], jnp.asarray(x[held]))
    beyond[:, 0] = 0
    best = beyond.argmin(axis=1)
    rows = np.arange(len(beyond))

    def paid(margin):
        return change[rows, np.where(beyond[rows, best] < -margin, best, 0)].mean()

    margin = min(MARGINS, key=paid)
    spread = np.maximum(change[:, 1:].var(axis=0), 1e-9)
    explained = 1 - ((beyond - change)[:, 1:] ** 2).mean(axis=0) / spread
    all_actions = jnp.concatenate(
        [base.act(jnp.asarray(labels.seen[0]))[None], jnp.asarray(actions, jnp.float32)]
    )
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *networks)
    numbers = (jnp.asarray(mean), jnp.asarray(scale), all_actions, jnp.float32(margin))
    return Predicted(stacked, *numbers, base.config), explained


def row(args: Arguments, step: str) -> tuple[str, ...]:
    """One row of the table."""
    began = time.perf_counter()

    def say(text):
        return print(f"{time.perf_counter() - began:5.0f} s  {text}", flush=True)

    agent = replace(AgentConfig() if step == "plain" else embedded(), **FREE)
    kind = SceneClass(10, 80, family="windows") if args.problems else SceneClass(10, 40)
    bank_config = BankConfig(kind, args.scenes, problems=tuple(map(str, args.problems)))
    rules = GameConfig(agent, reward="constant", tolerance=1e-4)
    options = agent.step_options(bank_config.options)
    key = jax.random.key(args.seed)
    split = make_split(
        bank_config, key, bank_config.options, rules.max_iterations, say, rules.tolerance
    )
    say(f"{len(split.train.initial_cost)} scenes, {len(split.held_out.initial_cost)} held out")
    constant = best_constant_action(kind, split.train, rules, options)
    base = always(constant, agent)
    say(f"base: action {constant:.2f}")
    actions = np.array([[action_of(agent, jnp.float32(decades))] for decades in DECADES]).clip(
        -1, 1
    )

    def game(bank):
        return make_game(rules, kind, bank, 1, bank_config.options)

    labels = collect(game(split.train), base, actions, args.seed)
    hindsight = np.exp(np.log(labels.iterations.min(axis=1) / labels.iterations[:, 0]).mean())
    say(f"{len(labels.scene)} states; the best first action of each in hindsight {hindsight:.3f}")
    policy, explained = fit(labels, base, actions, args.seed)
    say(f"R2 of the actions {np.round(explained, 2)}, margin {float(policy.margin):.2f}")
    taken = {}
    for name, one, looks in (
        ("base", base, False),
        ("foresight", base, True),
        ("predicted", policy, False),
    ):
        taken[name], _ = look_ahead(game(split.held_out), one, actions, looks)
        say(f"{name}: {np.exp(np.log(taken[name]).mean()):.2f} iterations")

    def shown(name):
        return "{:.3f} [{:.3f}, {:.3f}]".format(*paired_ratio(taken[name], taken["base"]))

    damping = 10 ** (0.5 * (agent.low + agent.high) + 0.5 * (agent.high - agent.low) * constant)
    source = f"{len(args.problems)} problems" if args.problems else "random"
    count = f"{len(split.train.initial_cost)} + {len(split.held_out.initial_cost)}"
    mean = f"{np.exp(np.log(taken['base']).mean()):.2f}"
    return (
        step,
        source,
        count,
        f"{damping:.0e}",
        mean,
        shown("foresight"),
        f"{explained.max():.2f}",
        shown("predicted"),
    )


HEADING = ("step", "scenes of", "number", "base λ", "iterations", "foresight", "R2", "predicted")


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark."""
    args = tyro.cli(Arguments, args=argv)
    jax.config.update("jax_enable_x64", True)
    prepare_process()
    with process.single_blas_thread():
        rows = [row(args, step) for step in args.steps]
    table = "\n".join(
        "| " + " | ".join(cells) + " |" for cells in (HEADING, ["---"] * len(HEADING), *rows)
    )
    print(table)
    if args.out:
        args.out.write_text(table + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
