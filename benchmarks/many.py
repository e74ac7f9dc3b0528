"""Problems a second: thousands of windows of real problems by `jaxba.solve_many`, beside C++ Ceres
and one by one.

    python -m benchmarks.many [--count 10000] [--peers 300]

`JAXBA_DATA` names the folder of real problems, and `JAXBA_CERES` the program with C++ Ceres
(benchmarks/README.md). Windows are neighbouring cameras, 5 to 20 of them, with 50 to 500 of the
points that they share, of BAL's and KITTI's problems; half of them disturbed by 0.3 degrees. Ceres
is timed on `--peers` of them by its own clock (without start and reading), one thread a problem,
and counted as two processes; DENSE_SCHUR, up to 100 iterations and `ftol` as ours. So is pycolmap,
without reading."""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import jax
import numpy as np

import jaxba
from benchmarks import peers
from benchmarks.default_policy import DEGREES, disturbed
from jaxba.bench.sources import sources
from jaxba.game.windows import covisible
from jaxba.lm.step import state_of
from jaxba.paper.subproblem import sub_problem
from jaxba.problem.bundle_problem import BundleProblem, ProblemError
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import numerics
from jaxba.solver.prepare import set_up
from jaxba.structure.cells import Sizes, work

FILES = (
    *("bal/problem-49-7776-pre", "bal/problem-21-11315-pre"),
    *("bal-converted/kitti00vo-250-24288-pre", "bal-converted/kittistereo00s-77-15638-pre"),
)
"""Problems that windows are cut from."""

CAMERAS = (5, 20)
POINTS = (50, 500)
"""Sizes of windows."""

MAPPED = 16
"""Solves of a batch of plain `vmap`."""

FEWEST = 6
"""Observations of a camera, below which it is left out of a window."""


def windows(count: int, seed: int = 0) -> Iterator[BundleProblem]:
    """Windows of the problems in turn."""
    folder = Path(os.environ["JAXBA_DATA"])
    rng = np.random.default_rng(seed)
    whole = [one.read() for one in sources([str(folder / f"{name}.txt.bz2") for name in FILES])]
    linked = [covisible(problem) for problem in whole]
    done = 0
    while done < count:
        problem = whole[done % len(whole)]
        shared = linked[done % len(whole)]
        chosen = [int(rng.integers(problem.num_cameras))]
        score = shared[chosen[0]].astype(float)
        for _ in range(int(rng.integers(CAMERAS[0], CAMERAS[1] + 1)) - 1):
            score[chosen] = -1
            chosen.append(int(score.argmax()))
            score += shared[chosen[-1]]
        most = int(np.exp(rng.uniform(*np.log(POINTS))))
        try:
            window = sub_problem(problem, chosen)
            points = rng.permutation(window.num_points)[:most].tolist()
            window = sub_problem(window, range(window.num_cameras), points)
            seen = np.bincount(window.camera_index, minlength=window.num_cameras)
            window = sub_problem(window, np.flatnonzero(seen >= FEWEST))
        except ProblemError:  # no common points
            continue
        if window.num_points >= POINTS[0] / 2 and window.num_cameras > 2:
            yield disturbed(window, int(rng.integers(1 << 30)), DEGREES[1]) if done % 2 else window
            done += 1


def ceres_seconds(problems: list[BundleProblem]) -> tuple[list[float], list[float]]:
    """Ceres' seconds and final costs; none without the program."""
    program = peers.program()
    seconds = []
    costs = []
    if program is None:
        return seconds, costs
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "window.txt"
        for problem in problems:
            jaxba.write_problem(problem, path)
            found = peers.run(program, path, "DENSE_SCHUR", 1, 100)
            seconds.append(found.total_s)
            costs.append(found.final_cost)
    return seconds, costs


def pycolmap_seconds(problems: list[BundleProblem]) -> list[float]:
    """pycolmap's seconds of the adjustment alone, without reading; none if it is not installed."""
    try:
        import pycolmap
    except ImportError:
        return []
    options = pycolmap.BundleAdjustmentOptions()
    seconds = []
    options.print_summary = False
    ceres = options.ceres.solver_options
    ceres.function_tolerance = 1e-6
    ceres.num_threads = 1
    ceres.max_num_iterations = 100
    with tempfile.TemporaryDirectory() as folder:
        for number, problem in enumerate(problems):
            path = Path(folder) / str(number)
            jaxba.write_colmap(problem, path)
            model = pycolmap.Reconstruction(path)
            config = pycolmap.BundleAdjustmentConfig()
            for image in model.images:
                config.add_image(image)
            began = time.perf_counter()
            pycolmap.create_default_bundle_adjuster(options, config, model).solve()
            seconds.append(time.perf_counter() - began)
    return seconds


def mapped_rate(problems: list[BundleProblem], policy: str) -> float:
    """Problems a second of `jax.vmap` over solves padded to the largest, `MAPPED` at a time,
    compiled before."""
    sizes = [Sizes.of(one)[:4] for one in problems]
    capacity = Sizes._make([*np.max(sizes, axis=0).tolist(), 0]).capacity
    setups = [set_up(one, policy, capacity=capacity) for one in problems]
    options = setups[0].options
    tolerances = jaxba.Tolerances()

    def solved(layout: jaxba.Layout, cameras: jax.Array, points: jax.Array) -> jax.Array:
        state = state_of(layout, cameras, points, options, np.float64)
        return jaxba.solve_loop(layout, state, setups[0].policy, tolerances, options, 100)[
            0
        ].state.cost

    program = jit(jax.vmap(solved))
    batches = [setups[at : at + MAPPED] for at in range(0, len(setups) - MAPPED + 1, MAPPED)]
    given = [
        jax.tree.map(lambda *x: np.stack(x), *[(one.layout, *one.start) for one in batch])
        for batch in batches
    ]
    with numerics(np.float64):
        jax.block_until_ready(program(*given[0]))
        began = time.perf_counter()
        for batch in given:
            jax.block_until_ready(program(*batch))
    return MAPPED * len(given) / (time.perf_counter() - began)


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--count", type=int, default=10_000)
    parser.add_argument("--peers", type=int, default=300)
    parser.add_argument("--policy", default="guarded")
    args = parser.parse_args()
    problems = list(windows(args.count))
    observations = np.array([one.num_observations for one in problems])
    print(
        f"{len(problems)} windows, {observations.mean():.0f} observations, median "
        f"{np.median(observations):.0f}"
    )
    few = problems[: args.peers]
    seconds, costs = ceres_seconds(few)
    if seconds:
        print(f"C++ Ceres, two processes: {2 / np.mean(seconds):.1f} a second")
    if by_colmap := pycolmap_seconds(few):
        print(f"pycolmap, two processes: {2 / np.mean(by_colmap):.1f} a second")

    began = time.perf_counter()
    times = []
    found = []
    for result in jaxba.solve_many(problems, args.policy):
        times.append(time.perf_counter() - began)
        found.append(result)
    failed = [one for one in found if isinstance(one, Exception)]
    solved = [one for one in found if not isinstance(one, Exception)]
    half = len(times) // 2
    steady = (len(times) - half) / (times[-1] - times[half - 1])
    print(
        f"solve_many: {len(times) / times[-1]:.1f} a second, {steady:.1f} in the second half, "
        f"first {times[0]:.1f} s"
    )
    cells = {one.capacity for one in solved if one.capacity is not None and one.capacity.fixed}
    sizes = np.array([Sizes.of(one)[:4] for one in problems])
    cell = np.array(
        [
            (c.cameras, c.points, c.observations, c.pairs) if c is not None else row
            for c, row in zip([getattr(one, "capacity", None) for one in found], sizes, strict=True)
        ]
    )
    share = 1 - work(sizes).sum() / work(cell).sum()
    print(f"{len(cells)} programs, {share:.0%} of the work is padding, {len(failed)} failed")
    print(
        f"iterations: mean {np.mean([one.iterations for one in solved]):.1f}, at the limit "
        f"{np.mean([one.iterations == 100 for one in solved]):.0%}"
    )

    options = jaxba.SolveOptions(compilation="quick")
    alone = []
    began = time.perf_counter()
    for problem in few[:100]:
        alone.append(jaxba.solve(problem, args.policy, options))
    print(
        f"solve, one by one, compilation included: {100 / (time.perf_counter() - began):.1f} a "
        "second"
    )
    print(
        f"vmap of {MAPPED}, without refilling or compilation: "
        f"{mapped_rate(few[:64], args.policy):.1f} a second"
    )
    above = np.array([a.final_cost / b.final_cost - 1 for a, b in zip(found, alone, strict=False)])
    print(
        f"end beside a solve alone: within 1e-6 in {np.mean(abs(above) < 1e-6):.0%}, largest "
        f"{above.max():.1e}"
    )
    if costs:
        above = np.array([a.final_cost / b - 1 for a, b in zip(found, costs, strict=False)])
        print(
            f"end beside Ceres': lower by 1e-4 in {np.mean(above < -1e-4):.0%}, higher in "
            f"{np.mean(above > 1e-4):.0%}"
        )


if __name__ == "__main__":
    main()
