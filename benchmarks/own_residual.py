"""BAL's projection as a user's residual beside the built-in one: costs, milliseconds an iteration,
compilation.

    python -m benchmarks.own_residual FILE ...

Both solve the same problem with Ceres' rule, fully compiled, on this machine; a row is the better
of three solves."""

from __future__ import annotations

import argparse

import jax
import jax.numpy as jnp
import numpy as np

import jaxba
from jaxba.runtime import process

OPTIONS = jaxba.SolveOptions(
    compilation="full", pad=False, max_iterations=12, linear_solver="explicit"
)


@jaxba.residual
def projection(pose, lens, point, *, pixel):
    """BAL's model, from the camera's frame with y down and z forward."""
    x, y, z = pose.to_camera(point)
    u = x / z
    v = -y / z
    square = u * u + v * v
    scale = lens.numbers[0] * (1 + lens.numbers[1] * square + lens.numbers[2] * square * square)
    return jnp.stack([scale * u, scale * v]) - pixel


def as_residuals(problem: jaxba.BundleProblem) -> jaxba.BundleProblem:
    """The problem with all but one of its observations as rows of `projection`."""
    rest = np.arange(1, problem.num_observations)
    one = np.arange(problem.num_observations) < 1
    camera = problem.camera_index[rest]
    point = problem.point_index[rest]
    rows = projection(pose=camera, lens=camera, point=point, pixel=problem.observations[rest])
    return jaxba.with_residual(problem.subset(one), rows)


def measured(problem: jaxba.BundleProblem) -> tuple[float, float, float]:
    """Final cost, seconds of compilation, and of an iteration."""
    solutions = [jaxba.solve(problem, "ceres", OPTIONS) for _ in range(3)]
    best = min(one.total_s / one.iterations for one in solutions)
    return solutions[0].final_cost, solutions[0].compile_s, best


def main() -> None:
    """Entry point."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("files", nargs="+")
    jax.config.update("jax_enable_x64", True)
    process.keep_memory()
    for path in parser.parse_args().files:
        problem = jaxba.read_problem(path)
        (cost, compiled, built_in), (own_cost, own_compiled, own) = map(
            measured, (problem, as_residuals(problem))
        )
        print(
            f"{path}: costs {abs(own_cost / cost - 1):.1e} apart, "
            f"an iteration {1e3 * built_in:.1f} and {1e3 * own:.1f} ms, ratio "
            f"{own / built_in:.2f}; "
            f"compilation {compiled:.1f} and {own_compiled:.1f} s"
        )


if __name__ == "__main__":
    main()
