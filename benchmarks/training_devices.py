"""A training divided over virtual devices: the same curve, and the work of each device.

    python -m benchmarks.training_devices [--devices 1,2,4] [--config paper-tuned] [--steps 32]

Devices on one CPU share its cores: what they show is the CPU time of each, XLA's count of operations of each, and that
the numbers stay. Each number of devices is a process of its own. Scenes are random and unsolved: only work counts.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import subprocess
import sys
import time


def measure(devices: int, config: str, steps: int) -> dict[str, float]:
    """One chunk, after one to warm up."""
    import jax
    import jax.numpy as jnp

    from jaxba.game.env import make_game
    from jaxba.game.random_scenes import make_scenes
    from jaxba.game.scene_bank import Bank, info_of, initial_costs
    from jaxba.runtime.distributed import use_devices
    from jaxba.runtime.process import single_blas_thread
    from jaxba.training.config import load
    from jaxba.training.placement import Placement
    from jaxba.training.train_loop import agent_shares, run_agents, start_agents

    jax.config.update("jax_enable_x64", True)
    chosen = use_devices(devices)
    settings = load(config)
    loop = dataclasses.replace(settings.loop, steps_per_chunk=steps)
    banks = []
    for kind in settings.bank.classes:
        scenes = make_scenes(kind, jax.random.key(0), 256, settings.bank.dtype)
        costs = initial_costs(kind, scenes)
        info = info_of(kind, scenes, costs, settings.game.max_iterations)
        banks.append(Bank(scenes, costs, costs / 20, info, jnp.full(256, 10.0)))
    game = make_game(settings.game, settings.bank.classes, banks, settings.envs, settings.step_options)
    place = Placement(chosen)
    env = place.on_all(place.divide(settings, game))
    keys = place.spread(jax.random.split(jax.random.key(0), 1), agent_shares(env))
    with single_blas_thread():
        state = start_agents(settings.sac, loop, env, keys, place.mesh)
        program = run_agents.lower(settings.sac, loop, env, state, place.mesh).compile()
        operations: dict[str, float] = program.cost_analysis() or {}
        state, _ = jax.block_until_ready(program(env, state))
        wall, cpu = time.perf_counter(), time.process_time()
        _, metrics = jax.block_until_ready(program(env, state))
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return {
        "devices": devices,
        "env_steps_per_s": steps * sum(settings.envs) / wall,
        "updates_per_s": steps * loop.updates_per_step / wall,
        "cpu_ms_per_device_and_step": 1e3 * cpu / steps / devices,
        "operations_per_device": operations.get("flops", 0.0),
        "critic_loss": float(metrics["critic_loss"][0]),
        "reward": float(metrics["reward"][0]),
    }


def main() -> None:
    """Prints a row for each number of devices."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--devices", default="1,2,4")
    parser.add_argument("--config", default="paper-tuned")
    parser.add_argument("--steps", type=int, default=32)
    parser.add_argument("--one", action="store_true", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one:
        print(json.dumps(measure(int(args.devices), args.config, args.steps)))
        return
    for count in args.devices.split(","):
        command = [sys.executable, "-m", "benchmarks.training_devices", "--one", "--devices", count]
        command += ["--config", args.config, "--steps", str(args.steps)]
        done = subprocess.run(command, capture_output=True, text=True)
        print(done.stdout.splitlines()[-1] if done.returncode == 0 else done.stderr.strip(), flush=True)


if __name__ == "__main__":
    main()
