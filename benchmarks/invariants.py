"""Solves thousands of random scenes with every damping rule and checks what must hold of every
iteration.

    python -m benchmarks.invariants --scenes 10000 --seed 0

No cost rises, no number of a state is not finite, no focal length changes its sign, lambda is
positive, and the last cost is that of the last parameters, evaluated anew. Iterations go on after
convergence, where costs differ by rounding alone. Scenes are those of the game before any selection
(`jaxba/game/random_scenes.py`), in equal parts of every family, wrong matches, bad starts and
scenes that nobody observes included. A start whose cost is not finite is left out and counted,
since `solve` refuses it."""

from __future__ import annotations

import functools
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jax import Array
from jaxtyping import Bool, Float

from jaxba import LMState
from jaxba.damping import POLICIES, DampingPolicy, ProblemInfo
from jaxba.game.random_scenes import SceneClass, SceneFamily, Scenes, make_scenes
from jaxba.game.scene_bank import info_of, initial_costs
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.step import lm_step
from jaxba.problem.options import StepOptions
from jaxba.runtime import process
from jaxba.runtime.groups import step_groups
from jaxba.solver.names import parse_solver

CLASSES: dict[SceneFamily, tuple[int, int]] = {"wide": (8, 24), "paper": (8, 12)}
"""Cameras and points of the scenes of each family: small, since many rules solve many of them."""

EMBEDDED = ("ceres+refine3", "ceres+embedded", "gauss-newton+embedded")
SOLVERS = (*POLICIES, "constant:1e-8", "constant:10", *EMBEDDED, "learned")
"""Every rule, some with embedded iterations, and the learned policy."""

COST_TOLERANCE = 1e-9
"""Largest relative difference of the root of the last cost and the same evaluated anew."""

PIXEL_ROUNDING = 1e-11
"""The same relative to the norm of all pixels, where nothing else is left of the cost."""


@dataclass(frozen=True)
class Arguments:
    """Options of the benchmark."""

    scenes: int = 10_000
    """Number of scenes, of all families together."""

    seed: int = 0
    """Of the scenes."""

    iterations: int = 25
    """Of every solve."""

    solvers: str = ",".join(SOLVERS)
    """Comma-separated names, as for `jaxba-bench`; plain LM in float64."""


class Found(NamedTuple):
    """What held of one scene, and its end."""

    rises: Bool[Array, ""]
    not_finite: Bool[Array, ""]
    flips: Bool[Array, ""]
    bad_lambda: Bool[Array, ""]
    state: LMState


NAMES = {
    "rises": "costs that rose",
    "not_finite": "numbers that are not finite",
    "flips": "focal lengths that changed their sign",
    "bad_lambda": "lambdas that are not positive",
    "wrong_cost": "last costs that are not those of the last parameters",
}
"""What is counted, in scenes."""


@functools.partial(jax.jit, static_argnames=("kind", "options", "iterations"))
def solve_all(
    kind: SceneClass,
    scenes: Scenes,
    costs: Float[Array, " scenes"],
    info: ProblemInfo,
    policy: DampingPolicy,
    options: StepOptions,
    iterations: int,
) -> Found:
    """Iterates every scene and watches it."""
    layout = class_layout(kind, options)

    def solve(scene: Scenes, cost: Array, info: ProblemInfo) -> Found:
        seen = with_scene(layout, scene.pixels, scene.mask)
        start = LMState(scene.cameras, scene.points, cost)
        sign = jnp.sign(start.cameras[6])

        def body(number: Array, carry: tuple) -> tuple:
            found, policy_state, damping = carry
            before = found.state
            state, step = lm_step(seen, before, damping, options, policy.min_gain, number)
            finite = functools.reduce(
                jnp.logical_and, [jnp.all(jnp.isfinite(x)) for x in state[:3]]
            )
            policy_state, after = policy.propose(policy_state, step)
            found = Found(
                found.rises | ~(state.cost <= before.cost),
                found.not_finite | ~finite,
                found.flips | jnp.any(jnp.sign(state.cameras[6]) != sign),
                found.bad_lambda | ~(damping > 0),
                state,
            )
            return found, policy_state, after.astype(damping.dtype)

        no = jnp.zeros((), bool)
        policy_state, damping = policy.init(info)
        carry = Found(no, no, no, no, start), policy_state, damping.astype(cost.dtype)
        return jax.lax.fori_loop(0, iterations, body, carry)[0]

    return step_groups(solve, scenes, costs, info)


def count_violations(
    kind: SceneClass, scenes: Scenes, name: str, iterations: int
) -> tuple[dict[str, int], float, int]:
    """Scenes that violate each invariant, the median of last over first costs, and the number of
    scenes.

    Args:
        kind: class of the scenes.
        scenes: all with finite costs.
        name: of a solver.
        iterations: of every solve.
    """
    policy, options = parse_solver(name).build()
    costs = initial_costs(kind, scenes)
    step = options.step_options(policy)
    found = solve_all(
        kind, scenes, costs, info_of(kind, scenes, costs, iterations), policy, step, iterations
    )
    ends = scenes._replace(cameras=found.state.cameras, points=found.state.points)
    anew = np.asarray(initial_costs(kind, ends))
    last = np.asarray(found.state.cost)
    counts = {field: int(np.sum(getattr(found, field))) for field in Found._fields[:-1]}
    pixels = np.linalg.norm(
        np.where(np.asarray(scenes.mask)[:, None], scenes.pixels, 0), axis=(1, 2)
    )
    bound = COST_TOLERANCE * np.sqrt(last) + PIXEL_ROUNDING * pixels
    counts["wrong_cost"] = int(np.sum(~(np.abs(np.sqrt(anew) - np.sqrt(last)) <= bound)))
    first = np.asarray(costs)
    return counts, float(np.median(last[first > 0] / first[first > 0])), len(last)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the benchmark. Exit status 1 if anything did not hold."""
    args = tyro.cli(Arguments, args=argv)
    jax.config.update("jax_enable_x64", True)
    families = tuple(CLASSES)
    total = dict.fromkeys(NAMES, 0)
    with process.single_blas_thread():
        for number, family in enumerate(families):
            kind = SceneClass(*CLASSES[family], family)
            count = args.scenes // len(families) + (number < args.scenes % len(families))
            scenes = make_scenes(kind, jax.random.fold_in(jax.random.key(args.seed), number), count)
            usable = np.flatnonzero(np.isfinite(initial_costs(kind, scenes)))
            scenes = jax.tree.map(lambda x, usable=usable: x[usable], scenes)
            print(
                f"{family}: {len(usable)} scenes, {count - len(usable)} more whose first cost is "
                "not finite",
                flush=True,
            )
            for name in args.solvers.split(","):
                started = time.perf_counter()
                counts, ratio, solved = count_violations(kind, scenes, name, args.iterations)
                for field, violations in counts.items():
                    total[field] += violations
                bad = (
                    ", ".join(f"{n} {NAMES[field]}" for field, n in counts.items() if n)
                    or "everything holds"
                )
                seconds = time.perf_counter() - started
                print(
                    f"  {name}: {solved * args.iterations} iterations, cost x{ratio:.2g}, {bad}, "
                    f"{seconds:.0f} s",
                    flush=True,
                )
    print("; ".join(f"{count} {NAMES[field]}" for field, count in total.items()))
    return int(any(total.values()))


if __name__ == "__main__":
    sys.exit(main())
