"""Gradient updates per second of jaxba's training loop, compared with SAC of sbx on the same task.

    python -m benchmarks.sac [--repeats 5] [--envs 64] [--out FILE]

The task is Pendulum with two hidden layers, batches of 256, and one update per vector step. The
width is 256, as in sbx, and 64, as in jaxba's preset. sbx (the package `sbx-rl`) runs with the
Python interpreter that `JAXBA_SBX` names; without it, sbx is left out with a message. Compilation
and warm-up are not counted. The two are timed alternately, and the least time of each is used,
since other work on the machine can only add to it."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from benchmarks.metrics import Metric, to_json, to_text
from jaxba.game.protocol import Step
from jaxba.training.config import load
from jaxba.training.sac import SacConfig
from jaxba.training.train_loop import LoopConfig, run_chunk, start
from jaxba.typing import register_pytree

VARIABLE = "JAXBA_SBX"
"""Environment variable with the path of a Python interpreter that has sbx-rl."""

TARGET = 250.0
"""Updates per second that the project aims at, with width 256 and batches of 256 on two cores."""

TOLERANCE = 0.25
"""Relative change of a ratio that the gate accepts, as in benchmarks/suite.py."""

LIMIT = 200
"""Steps of an episode. Source: Gymnasium's Pendulum-v1, as all constants of `Pendulum`."""


class _Swing(NamedTuple):
    angle: Array
    speed: Array
    clock: Array
    key: Array


@register_pytree
@dataclass(frozen=True)
class Pendulum:
    """Gymnasium's Pendulum-v1: mass 1 kg, length 1 m, gravity 10 m/s^2, torque at most 2 Nm, steps
    of 0.05 s."""

    num_envs: int = dataclasses.field(metadata={"static": True})
    """Number of pendulums."""

    observation_size = 3
    privileged_size = 0
    action_size = 1

    def reset(self, key: Array) -> tuple[_Swing, Array]:
        """See `Environment`."""
        key, angle, speed = jax.random.split(key, 3)
        state = _Swing(
            jax.random.uniform(angle, (self.num_envs,), jnp.float32, -math.pi, math.pi),
            jax.random.uniform(speed, (self.num_envs,), jnp.float32, -1, 1),
            jnp.zeros(self.num_envs, jnp.int32),
            key,
        )
        return state, self._see(state)

    def step(self, state: _Swing, action: Array) -> tuple[_Swing, Step]:
        """See `Environment`."""
        torque = 2 * action[:, 0]
        angle = (state.angle + math.pi) % (2 * math.pi) - math.pi
        reward = -(angle**2 + 0.1 * state.speed**2 + 0.001 * torque**2)
        speed = jnp.clip(state.speed + (15 * jnp.sin(angle) + 3 * torque) * 0.05, -8, 8)
        moved = _Swing(angle + speed * 0.05, speed, state.clock + 1, state.key)
        ended = moved.clock >= LIMIT
        fresh, _ = self.reset(state.key)

        def choose(new, old):
            return jnp.where(ended, new, old)

        angle, speed, clock = map(choose, fresh[:3], moved[:3])
        after = _Swing(angle, speed, clock, fresh.key)
        metrics = {"length": moved.clock.astype(jnp.float32)}
        return after, Step(
            self._see(after), reward, jnp.zeros_like(ended), ended, self._see(moved), metrics
        )

    def demonstrate(self, state: Any, key: Array) -> Array:
        """See `Environment`."""
        return jax.random.uniform(key, (self.num_envs, 1), jnp.float32, -1, 1)

    def _see(self, state: _Swing) -> Array:
        return jnp.stack([jnp.cos(state.angle), jnp.sin(state.angle), state.speed], axis=1)


PEER = """
import json, sys, time
import jax
from sbx import SAC
updates, together = int(sys.argv[1]), int(sys.argv[2])
model = SAC("MlpPolicy", "Pendulum-v1", batch_size=256, buffer_size=100_000,
            learning_starts=256, seed=0, train_freq=together,
            gradient_steps=together, policy_kwargs={"net_arch": [256, 256]})
model.learn(512 + 2 * together)
print("READY", flush=True)
for _ in sys.stdin:
    before, cpu, wall = model._n_updates, time.process_time(), time.perf_counter()
    model.learn(updates, reset_num_timesteps=False)
    jax.block_until_ready(model.policy.qf_state.params)
    wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    print(json.dumps([model._n_updates - before, wall, cpu]), flush=True)
"""
"""Program for the interpreter `JAXBA_SBX`: makes a measurement for each line on its standard
input."""


class Sample(NamedTuple):
    """One measurement."""

    updates: int
    wall_s: float
    cpu_s: float


def ours(config: SacConfig, envs: int, updates: int) -> Callable[[], Sample]:
    """A function that measures jaxba's loop with one update per vector step, after compilation and
    warm-up."""
    env = jax.device_put(Pendulum(envs))
    loop = LoopConfig(100_000, 1000, 1, updates)
    state, _ = run_chunk(config, loop, env, start(config, loop, env, jax.random.key(0)))
    held = [jax.block_until_ready(state)]

    def measure() -> Sample:
        cpu = time.process_time()
        wall = time.perf_counter()
        held[0], _ = jax.block_until_ready(run_chunk(config, loop, env, held[0]))
        return Sample(updates, time.perf_counter() - wall, time.process_time() - cpu)

    return measure


class Sbx:
    """sbx in a separate process, which waits between measurements."""

    def __init__(self, python: str, updates: int, together: int) -> None:
        self._process = subprocess.Popen(
            [python, "-W", "ignore", "-c", PEER, str(updates), str(together)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            text=True,
        )
        while (line := self._read()) != "READY":
            print(f"sbx: {line}", file=sys.stderr)

    def _read(self) -> str:
        line = self._process.stdout.readline() if self._process.stdout else ""
        if not line:
            raise OSError(f"sbx ended with status {self._process.wait()}")
        return line.strip()

    def __call__(self) -> Sample:
        """Makes a measurement."""
        if self._process.stdin:
            self._process.stdin.write("go\n")
            self._process.stdin.flush()
        return Sample(*json.loads(self._read()))

    def close(self) -> None:
        """Ends the process."""
        self._process.terminate()
        self._process.wait()


def run(repeats: int, envs: int, updates: int) -> list[Metric]:
    """Measures all programs alternately."""
    peer_like = SacConfig(width=256, layer_norm=False)
    programs: dict[str, Callable[[], Sample]] = {
        "jaxba, width 256": ours(peer_like, envs, updates),
        "jaxba, width 64": ours(dataclasses.replace(peer_like, width=64), envs, 5 * updates),
        "jaxba, default (64, layer norm)": ours(SacConfig(), envs, 5 * updates),
        "jaxba, paper": ours(load("paper").sac, envs, updates),
    }
    peers: list[Sbx] = []
    python = os.environ.get(VARIABLE, "")
    try:
        for name, together in (("sbx, width 256", 1), ("sbx, width 256, 64 updates at once", 64)):
            if python:
                programs[name] = peer = Sbx(python, updates - updates % 64, together)
                peers.append(peer)
    except OSError as error:
        print(f"left out: {error}", file=sys.stderr)
    if not python:
        print(f"left out: sbx ({VARIABLE} names no Python)", file=sys.stderr)
    samples: dict[str, list[Sample]] = {name: [] for name in programs}
    try:
        for _ in range(repeats):
            for name, measure in programs.items():
                samples[name].append(measure())
    finally:
        for peer in peers:
            peer.close()
    return list(_metrics(samples))


def _metrics(samples: dict[str, list[Sample]]) -> Iterator[Metric]:
    speed = {}
    for name, taken in samples.items():
        best = min(taken, key=lambda s: s.wall_s / s.updates)
        speed[name] = best.updates / best.wall_s
        target = TARGET if name == "jaxba, width 256" else None
        yield Metric(f"sac/{name}", speed[name], "1/s", "higher", target=target)
        yield Metric(f"sac/{name}: cores used", best.cpu_s / best.wall_s, "cores", "higher")
        per_core = max(s.updates / s.cpu_s for s in taken)
        yield Metric(f"sac/{name}: of one core", per_core, "1/s", "higher")
    for name in speed:
        if name.startswith("sbx"):
            ratio = speed["jaxba, width 256"] / speed[name]
            yield Metric(f"sac/jaxba over {name}", ratio, "ratio", "higher", TOLERANCE)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description="Gradient updates per second, compared with sbx.")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--envs", type=int, default=64, help="number of pendulums")
    parser.add_argument(
        "--updates", type=int, default=512, help="number of gradient updates in a measurement"
    )
    parser.add_argument("--out", default="", help="output file of the metrics as JSON")
    args = parser.parse_args()
    metrics = run(args.repeats, args.envs, args.updates)
    print(to_text(metrics))
    if args.out:
        from jaxba.bench.run import machine

        Path(args.out).write_text(to_json(metrics, machine()))


if __name__ == "__main__":
    main()
