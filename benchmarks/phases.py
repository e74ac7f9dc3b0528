"""Time of each phase of an LM step, compared with the limit by memory bandwidth.

    python -m benchmarks.phases PROBLEM [--solver explicit|sparse|implicit] [--refine 3] [--repeats
    30]

PROBLEM is a file or a random scene (`scene:random-150`). `bound` is the time to move the inputs and
outputs of a phase once with the measured bandwidth of a copy; `bound/min` is that over the shortest
measured time."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from jaxba.bench.sources import sources
from jaxba.linear import formed, reduced_system, schur
from jaxba.linear.band_cholesky import band_factor
from jaxba.linear.cholesky import factor_and_solve
from jaxba.linear.two_level import coarse_preconditioner
from jaxba.lm import step
from jaxba.model.linearize import cost, linearize, slot_frames
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import Refinement, StepOptions
from jaxba.refinement.cameras import refine_cameras
from jaxba.refinement.points import refine_points
from jaxba.runtime import process
from jaxba.structure.layout import Layout, build_layout


def _factor(layout: Layout, blocks: jax.Array, right: jax.Array) -> jax.Array:
    """Solves a system that is formed in blocks, as a band or dense."""
    pairs = layout.part("pairs")
    if pairs.band is None:
        return factor_and_solve(formed.dense_blocks(pairs, blocks), right.reshape(-1))
    return band_factor(pairs.band, blocks).solve(right)


def timed(function: Any, *arguments: Any, repeats: int) -> tuple[Any, float, float, float]:
    """Result of a function, least and median seconds of a call, and seconds of its compilation."""
    started = time.perf_counter()
    compiled = jax.jit(function).lower(*arguments).compile()
    compile_s = time.perf_counter() - started
    result = jax.block_until_ready(compiled(*arguments))
    times = []
    for _ in range(repeats):
        started = time.perf_counter()
        jax.block_until_ready(compiled(*arguments))
        times.append(time.perf_counter() - started)
    return result, min(times), float(np.median(times)), compile_s


def size(tree: Any) -> int:
    """Size of all arrays in a pytree, bytes."""
    return sum(x.nbytes for x in jax.tree.leaves(tree) if hasattr(x, "nbytes"))


def bandwidth() -> float:
    """Bandwidth of a large copy, bytes per second; reads and writes count."""
    x = jnp.ones(1 << 23, jnp.float64)
    _, least, _, _ = timed(lambda x: x + 1.0, x, repeats=20)
    return 2 * x.nbytes / least


class Phase(NamedTuple):
    """A row of the table."""

    name: str
    least_s: float
    median_s: float
    bound_s: float  # time to move inputs and outputs once, without index arrays
    compile_s: float

    def __str__(self) -> str:
        times = f"{1e3 * self.least_s:8.2f} {1e3 * self.median_s:8.2f} {1e3 * self.bound_s:9.2f}"
        return f"{self.name:14s} {times} {self.bound_s / self.least_s:9.0%} {self.compile_s:9.2f}"


HEADING = (
    f"{'phase':14s} {'min ms':>8s} {'median':>8s} {'bound ms':>9s} {'bound/min':>9s} "
    f"{'compile s':>9s}"
)


def measure(
    layout: Layout, problem: BundleProblem, options: StepOptions, rate: float, repeats: int
) -> Iterator[Phase]:
    """Times each phase of a step as a separately compiled program, then complete steps.

    Args:
        layout: layout of the problem for these options, on the device.
        problem: the problem.
        options: the step; `refinement` only matters where refinement is timed.
        rate: bandwidth of a copy, bytes per second.
        repeats: runs of each phase.
    """
    done: dict[str, Any] = {}

    def phase(name: str, function: Any, *arguments: Any) -> Phase:
        """Times a function of the layout and other arguments. The layout must be an argument, as in
        a step, since XLA would compile its index arrays differently as constants."""
        done[name], least, median, compile_s = timed(function, layout, *arguments, repeats=repeats)
        return Phase(name, least, median, (size(arguments) + size(done[name])) / rate, compile_s)

    plain = replace(options, refinement=Refinement())
    state = step.initial_state(layout, problem, plain)
    damping = jnp.asarray(1e-4)
    yield phase("linearise", lambda la, s: linearize(la, s.cameras, s.points, plain.loss), state)
    linear = done["linearise"]

    def system_of(la, li, s):
        return schur.DampedSystem.of(la, li, s.cameras, s.points, damping, plain)[2:4]

    yield phase(
        "eliminate", lambda la, li, d: schur.eliminate_points(la, li, d, plain), linear, damping
    )
    yield phase("eliminate, sum", system_of, linear, state)
    points, system = done["eliminate, sum"]

    def whole(la: Layout, li: Any, po: Any, sy: Any, s: Any) -> schur.DampedSystem:
        rotation = schur.rotation_coordinates(s.cameras, plain)
        at = s.cameras, s.points
        return schur.DampedSystem(
            la, li, po, sy, damping, at, rotation, plain.conjugate_gradients.forcing
        )

    parts = linear, points, system, state
    if layout.grid is not None:
        yield phase("form", lambda *parts: formed.dense_system(whole(*parts)), *parts)

        def factor(_, m, x):
            return factor_and_solve(m, x.reshape(-1))

        yield phase("factor", factor, done["form"], system.right)
    elif plain.forms_reduced_system:
        yield phase("form", lambda *parts: formed.reduced_blocks(whole(*parts)), *parts)
        direct = plain.linear_solver == "explicit"
        solve = _factor if direct else formed.apply_blocks
        name = "factor" if direct else "one product"
        yield phase(name, lambda la, b, x: solve(la, b, x), done["form"], system.right)
    else:
        yield phase(
            "one product", lambda *parts: schur.apply_reduced(whole(*parts), parts[3].right), *parts
        )
    if plain.uses_camera_clusters:

        def coarse(*parts):
            return coarse_preconditioner(whole(*parts))(parts[3].right)

        yield phase("coarse system", coarse, *parts)
    yield phase(
        "reduced solve", lambda *parts: reduced_system.solve_reduced(whole(*parts), plain), *parts
    )
    yield phase(
        "back-substitute",
        lambda *parts: schur.back_substitute(whole(*parts), parts[3].right),
        *parts,
    )
    yield phase("cost", lambda la, s: cost(la, s.cameras, s.points, plain.loss), state)
    count = options.refinement.points
    if count:

        def refine(la, s):
            return refine_points(
                la, s.cameras, slot_frames(la, s.cameras), s.points, plain.loss, count
            )

        yield phase(f"refine {count}", refine, state)
        yield phase(
            "refine cameras", lambda la, s: refine_cameras(la, s.cameras, s.points, plain), state
        )
    yield phase("whole step", lambda la, s: step.lm_step(la, s, damping, plain), state)
    if count:
        yield phase(
            f"step, refine {count}", lambda la, s: step.lm_step(la, s, damping, options), state
        )


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("problem")
    parser.add_argument("--solver", default="explicit", choices=("explicit", "sparse", "implicit"))
    parser.add_argument("--refine", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=30)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    problem = sources([args.problem])[0].read()
    options = StepOptions(linear_solver=args.solver, refinement=Refinement(points=args.refine))
    started = time.perf_counter()
    arrays = build_layout(problem, options)
    print(
        f"{problem.num_cameras} cameras, {problem.num_points} points, {problem.num_observations} "
        "observations"
    )
    print(
        f"layout on the host {1e3 * (time.perf_counter() - started):.2f} ms; {arrays.num_slots} "
        "slots"
    )
    rate = bandwidth()
    print(f"copy bandwidth {rate / 1e9:.1f} GB/s, device {jax.devices()[0].device_kind}")
    print(HEADING)
    for phase in measure(jax.device_put(arrays), problem, options, rate, args.repeats):
        print(phase, flush=True)


if __name__ == "__main__":
    with process.single_blas_thread():
        main()
