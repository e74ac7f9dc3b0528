"""A whole training of the game by jaxba's loop and by SAC of sbx: steps and updates a second,
seconds to a score.

    python -m benchmarks.trainer [--envs 64] [--updates 32] [--limit 600] [--out FILE]

Needs sbx-rl and the extra gym in the same Python. Both play the same scenes with networks of two
layers of 64, batches of 256 and as many updates after each vector step, and are stopped now and
then for the score of the mean action on held-out scenes; its time and that of compilation are not
counted. The score to reach is `TARGET` of Ceres' rule's."""

from __future__ import annotations

import dataclasses
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import numpy as np
import tyro

import jaxba
from benchmarks.metrics import Metric, to_json, to_text
from jaxba.damping.learned import Layer, LearnedPolicy, learned_from
from jaxba.game.evaluate import evaluate
from jaxba.runtime.numerics import numerics
from jaxba.training.api import PresetGame
from jaxba.training.train_loop import run_chunk, start

TARGET = 0.9
"""Of the iterations that Ceres' rule takes on the held-out scenes, 40 for a failure."""

EVERY = 50
"""Vector steps between two scores."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    envs: int = 64
    """Scenes in play."""

    updates: int = 32
    """Updates after each vector step."""

    scenes: int = 2000
    """Scenes drawn."""

    limit: float = 600.0
    """Seconds of training after which a trainer has not reached the score."""

    out: str = ""
    """File of the metrics as JSON."""


@dataclass
class Run:
    """What a trainer has done so far, without compilation and scores."""

    steps: int = 0
    updates: int = 0
    seconds: float = 0.0
    reached: float = float("nan")
    scores: list[float] = dataclasses.field(default_factory=list)


def score(env: PresetGame, policy: Any) -> float:
    """Mean iterations on the held-out scenes."""
    rules = env.config
    limits = rules.tolerance, rules.max_iterations
    with numerics("float64"):
        return evaluate(env.kind, env.held_out, policy, env.options, *limits).mean


def ours(env: PresetGame, limit: float, target: float) -> Iterator[Run]:
    """jaxba's compiled loop."""
    config = env.preset
    run = Run()
    loop = dataclasses.replace(config.loop, steps_per_chunk=EVERY)
    with numerics("float64"):
        state = start(config.sac, loop, env, jax.random.key(1))
        # compiles; not counted as time
        state, _ = jax.block_until_ready(run_chunk(config.sac, loop, env, state))
    while run.seconds < limit and not run.reached > 0:
        began = time.perf_counter()
        with numerics("float64"):
            state, _ = jax.block_until_ready(run_chunk(config.sac, loop, env, state))
        run.seconds += time.perf_counter() - began
        run.steps, run.updates = (
            run.steps + EVERY * env.num_envs,
            run.updates + EVERY * loop.updates_per_step,
        )
        yield judged(run, score(env, learned_from(env.config.agent, state.learner.actor)), target)


def peer(env: PresetGame, limit: float, target: float) -> Iterator[Run]:
    """SAC of sbx, by way of Gymnasium."""
    from sbx import SAC  # pyright: ignore[reportMissingImports]

    from examples.gym_sbx import ForStableBaselines
    from jaxba.game.gym import GymVectorGame

    loop = env.preset.loop
    run = Run()
    model = SAC(
        "MlpPolicy",
        ForStableBaselines(GymVectorGame(env, "SameStep")),
        learning_starts=loop.warmup_steps,
        buffer_size=loop.replay_capacity,
        batch_size=256,
        train_freq=1,
        gradient_steps=loop.updates_per_step,
        policy_kwargs={"net_arch": [64, 64]},
        seed=1,
    )
    model.learn(loop.warmup_steps + EVERY * env.num_envs)  # compiles; not counted as time
    while run.seconds < limit and not run.reached > 0:
        steps = model.num_timesteps
        updates = model._n_updates
        began = time.perf_counter()
        model.learn(EVERY * env.num_envs, reset_num_timesteps=False)
        jax.block_until_ready(model.policy.actor_state.params)
        run.seconds += time.perf_counter() - began
        run.steps, run.updates = (
            run.steps + model.num_timesteps - steps,
            run.updates + model._n_updates - updates,
        )
        yield judged(run, score(env, policy_of(env, model.policy.actor_state.params)), target)


def policy_of(env: PresetGame, actor: Any) -> LearnedPolicy:
    """The policy of an actor of sbx: hidden layers, then one layer for the mean and one for the
    deviation."""
    stack = [actor["params"][f"Dense_{k}"] for k in range(len(actor["params"]))]
    *hidden, mean, deviation = [
        Layer(np.asarray(one["kernel"]), np.asarray(one["bias"])) for one in stack
    ]
    last = Layer(*(np.concatenate(both, axis=-1) for both in zip(mean, deviation, strict=True)))
    return LearnedPolicy((*hidden, last), env.config.agent)


def judged(run: Run, found: float, target: float) -> Run:
    """The run with a score."""
    run.scores.append(found)
    if found <= target and not run.reached > 0:
        run.reached = run.seconds
    return run


def main() -> None:
    """Prints the table."""
    args = tyro.cli(Arguments, description=__doc__)
    sizes = (
        f"bank.scenes={args.scenes}",
        f"envs={args.envs}",
        f"loop.updates_per_step={args.updates}",
    )
    env = jaxba.make_env("default", *sizes, "sac.batch=256", report=print)
    rule = score(env, jaxba.make_policy("ceres"))
    print(
        f"held-out scenes: Ceres' rule takes {rule:.2f} iterations, to reach {TARGET * rule:.2f}",
        flush=True,
    )
    metrics = []
    done = {}
    for name, trainer in (("jaxba", ours), ("sbx", peer)):
        for run in trainer(env, args.limit, TARGET * rule):
            print(
                f"{name}: {run.seconds:.1f} s, {run.steps} steps, score {run.scores[-1]:.2f}",
                flush=True,
            )
            done[name] = run
        run = done[name]
        metrics += [
            Metric(f"trainer/{name}: steps", run.steps / run.seconds, "1/s", "higher"),
            Metric(f"trainer/{name}: updates", run.updates / run.seconds, "1/s", "higher"),
            Metric(f"trainer/{name}: to the score", run.reached, "s", "lower"),
        ]
    ratio = (
        done["jaxba"].updates / done["jaxba"].seconds / (done["sbx"].updates / done["sbx"].seconds)
    )
    metrics.append(Metric("trainer/jaxba over sbx: updates", ratio, "ratio", "higher", target=5.0))
    print(to_text(metrics))
    if args.out:
        from jaxba.bench.run import machine

        Path(args.out).write_text(to_json(metrics, machine()))


if __name__ == "__main__":
    main()
