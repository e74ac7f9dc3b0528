"""A solve on several devices beside one: costs of every iteration, collectives, memory, seconds.

    python -m benchmarks.devices [--devices 1,2,4,8] [--problems FILE ...] [--solvers guarded,ceres]
    [--iterations 10]

On a CPU the devices are virtual and share its cores, so that seconds show what the division costs,
not what it gains. By default two BAL and two other real problems of `JAXBA_DATA`. For every
problem, solver and linear solver the table has the largest relative difference of a cost from that
on one device over the iterations, and seconds over those of one device. Then the sums over devices
in the program of an iteration, and the bytes of layout and parameters on each."""

from __future__ import annotations

import argparse
import dataclasses
import os
from pathlib import Path

import jax
import numpy as np

import jaxba
from jaxba.runtime.numerics import numerics
from jaxba.solver import sharded
from jaxba.solver.names import parse_solver
from jaxba.solver.prepare import Setup, set_up

PROBLEMS = (
    "bal/problem-49-7776-pre.txt.bz2",
    "bal/problem-21-11315-pre.txt.bz2",
    "bal-converted/sba-54-5207-pre.txt.bz2",
    "bal-converted/colmap-ranjith-13-3550-post.txt.bz2",
)
LINEAR_SOLVERS = ("explicit", "sparse", "implicit", "cg")


def collectives(setup: Setup) -> int:
    """Sums and maxima over devices in the text of the program of one iteration."""
    assert setup.shards is not None
    with numerics(setup.dtype):
        limit = np.asarray(10, np.int32)
        carry = setup.shards.begin(setup.policy, limit)
        given = setup.shards.layout, carry, setup.policy, jaxba.Tolerances(), limit
        lowered = sharded._run.lower(*given, **setup.shards.static, length=0)
    return lowered.as_text().count("stablehlo.all_reduce")


def bytes_per_device(setup: Setup) -> list[int]:
    """Bytes of the layout on each device."""
    assert setup.shards is not None
    found: dict[int, int] = {}
    for leaf in jax.tree.leaves(setup.shards.layout):
        for shard in leaf.addressable_shards:
            found[shard.device.id] = found.get(shard.device.id, 0) + shard.data.nbytes
    return list(found.values())


def main() -> None:
    """Prints the tables."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--devices", default="1,2,4,8")
    parser.add_argument("--problems", nargs="*", default=None)
    parser.add_argument("--solvers", default="guarded,ceres")
    parser.add_argument("--linear-solvers", default=",".join(LINEAR_SOLVERS))
    parser.add_argument("--iterations", type=int, default=10)
    args = parser.parse_args()
    counts = [int(count) for count in args.devices.split(",")]
    jax.config.update("jax_num_cpu_devices", max(counts))
    jax.config.update("jax_enable_x64", True)
    folder = Path(os.environ.get("JAXBA_DATA", "."))
    files = args.problems or [str(folder / name) for name in PROBLEMS]
    print(
        f"{'problem':28s}{'solver':10s}{'linear':10s}"
        + "".join(f"{f'{n} devices':>24s}" for n in counts[1:])
    )
    for file in files:
        problem = jaxba.read_problem(file)
        for name in args.solvers.split(","):
            for linear_solver in args.linear_solvers.split(","):
                policy, options = parse_solver(name).build()
                options = dataclasses.replace(
                    options,
                    linear_solver=linear_solver,
                    compilation="full",
                    max_iterations=args.iterations,
                )
                runs = []
                for count in counts:
                    one = dataclasses.replace(options, devices=count)
                    jaxba.solve(problem, policy, one)
                    runs.append(jaxba.solve(problem, policy, one))
                cells = [_cell(run, runs[0]) for run in runs[1:]]
                stem = Path(file).name.split(".")[0].removeprefix("colmap-")[:26]
                print(
                    f"{stem:28s}{name:10s}{linear_solver:10s}"
                    + "".join(f"{cell:>24s}" for cell in cells),
                    flush=True,
                )
    for linear_solver in args.linear_solvers.split(","):
        for name in args.solvers.split(","):
            policy, options = parse_solver(name).build()
            one = dataclasses.replace(options, linear_solver=linear_solver, devices=max(counts))
            setup = set_up(problem, policy, one)
            print(f"collectives in an iteration, {name}, {linear_solver}: {collectives(setup)}")
    for count in counts[1:]:
        setup = set_up(
            problem, "ceres", jaxba.SolveOptions(linear_solver="implicit", devices=count)
        )
        sizes = bytes_per_device(setup)
        print(
            f"layout on each of {count} devices, implicit: {min(sizes):,} to {max(sizes):,} bytes"
        )


def _cell(run: jaxba.Solution, one: jaxba.Solution) -> str:
    shared = min(len(run.history.cost), len(one.history.cost))
    away = np.max(np.abs(run.history.cost[:shared] / one.history.cost[:shared] - 1), initial=0.0)
    return f"{away:.1e} ({run.iterations}/{one.iterations}) x{run.total_s / one.total_s:.2f}"


if __name__ == "__main__":
    main()
