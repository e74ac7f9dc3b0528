"""Time of every phase of one LM step, beside the bytes it must move.

    python benchmarks/phases.py PROBLEM [--solver explicit|sparse|implicit] [--refine 3] [--repeats 30]

PROBLEM is a file or a random scene (`scene:random-150`). `least` is the time that the measured copy bandwidth needs
for the phase's inputs and outputs, each moved once; `share` is that over the measured time.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxba import camera, eliminate, host, lm, reduced
from jaxba.bench.sources import sources
from jaxba.coarse import Anchor, coarse_preconditioner
from jaxba.layout import layout_for
from jaxba.linearize import linearize, residuals, slot_costs, slot_frames
from jaxba.options import StepOptions
from jaxba.refine import refine_points


def timed(function: Any, *arguments: Any, repeats: int) -> tuple[Any, float, float, float]:
    """Result, least and median seconds, and seconds of compilation."""
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
    """Bytes of all arrays in a pytree."""
    return sum(x.nbytes for x in jax.tree.leaves(tree) if hasattr(x, "nbytes"))


def bandwidth() -> float:
    """Bytes per second of a large copy, read and write counted."""
    x = jnp.ones(1 << 23, jnp.float64)
    _, least, _, _ = timed(lambda x: x + 1.0, x, repeats=20)
    return 2 * x.nbytes / least


def main() -> None:
    """Prints the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("problem")
    parser.add_argument("--solver", default="explicit", choices=("explicit", "sparse", "implicit"))
    parser.add_argument("--refine", type=int, default=3)
    parser.add_argument("--repeats", type=int, default=30)
    args = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    host.keep_memory()
    problem = sources([args.problem])[0].read()
    options = StepOptions(linear_solver=args.solver)
    started = time.perf_counter()
    arrays = layout_for(problem, options)
    print(f"{problem.num_cameras} cameras, {problem.num_points} points, {problem.num_observations} observations")
    print(f"layout on the host {1e3 * (time.perf_counter() - started):.2f} ms; {arrays.num_slots} slots")
    layout = jax.device_put(arrays)
    rate = bandwidth()
    print(f"copy bandwidth {rate / 1e9:.1f} GB/s, device {jax.devices()[0].device_kind}")
    print(f"{'phase':14s} {'min ms':>8s} {'median':>8s} {'least ms':>9s} {'share':>6s} {'compile s':>9s}")

    def phase(name: str, function: Any, *arguments: Any) -> Any:
        result, least, median, compile_s = timed(function, *arguments, repeats=args.repeats)
        floor = (size(arguments) + size(result)) / rate
        times = f"{1e3 * least:8.2f} {1e3 * median:8.2f} {1e3 * floor:9.2f} {floor / least:6.0%} {compile_s:9.2f}"
        print(f"{name:14s} {times}")
        return result

    state = lm.initial_state(layout, problem, options)
    index = (layout.slot_camera, layout.slot_point, layout.slot_mask, layout.pixels)
    damping = jnp.asarray(1e-4)
    linear = phase("linearise", lambda s, _: linearize(layout, s.cameras, s.points, options.loss), state, index)
    points = phase("eliminate", lambda li, d: eliminate.eliminate_points(layout, li, d, options), linear, damping)
    turn = eliminate.Coordinates.of(state.cameras, options)
    system = phase(
        "camera sums", lambda li, po: eliminate.camera_system(layout, li, po, turn, damping, options), linear, points
    )
    if options.forms_reduced_system:
        blocks = phase("form", lambda li, po, sy: reduced.reduced_blocks(layout, li, po, sy), linear, points, system)
        if args.solver == "explicit":
            phase(
                "factor",
                lambda b, x: reduced.factor_blocks(layout, b, x),
                blocks,
                system.right,
            )
        else:
            phase("one product", lambda b, x: reduced.apply_blocks(layout, b, x), blocks, system.right)
    else:
        phase(
            "one product",
            lambda li, po, sy, x: eliminate.apply_reduced(layout, li, po, sy, x),
            linear,
            points,
            system,
            system.right,
        )
    frames = camera.frames(state.cameras)
    anchor = Anchor(frames.rotation, frames.translation, state.points)
    if options.uses_clusters:
        phase(
            "coarse system",
            lambda li, po, sy, x: coarse_preconditioner(layout, li, po, sy, anchor)(x),
            linear,
            points,
            system,
            system.right,
        )
    phase(
        "reduced solve",
        lambda li, po, sy: reduced.solve_reduced(layout, li, po, sy, anchor, options),
        linear,
        points,
        system,
    )
    phase(
        "back-substitute", lambda li, po, x: eliminate.back_substitute(layout, li, po, x), linear, points, system.right
    )

    def cost(state: Any) -> Any:
        frames = slot_frames(layout, state.cameras)
        return jnp.sum(slot_costs(options.loss, residuals(layout, frames, state.points)[1]))

    phase("cost", cost, state)
    if args.refine:

        def refine(state: Any) -> Any:
            return refine_points(layout, slot_frames(layout, state.cameras), state.points, options.loss, args.refine)

        phase(f"refine {args.refine}", refine, state)
    phase("whole step", lambda la, s: lm.lm_step(la, s, damping, options), layout, state)
    if args.refine:
        refined = StepOptions(linear_solver=args.solver, refine_points=args.refine)
        phase(f"step, refine {args.refine}", lambda la, s: lm.lm_step(la, s, damping, refined), layout, state)


if __name__ == "__main__":
    with host.calm_blas():
        main()
