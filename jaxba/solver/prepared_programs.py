"""Programs compiled before they are wanted: those of problems that are given, or of usual kinds and
sizes."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from jaxba.damping import DampingPolicy
from jaxba.lm.termination import Tolerances
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.hold import hold
from jaxba.problem.intrinsics import LENS_SIZE, Lenses
from jaxba.problem.losses import Loss
from jaxba.runtime import process
from jaxba.runtime.compilation import CompileClock
from jaxba.runtime.numerics import numerics
from jaxba.runtime.program_cache import keep_programs_by_default, programs_are_kept
from jaxba.scenes import SceneConfig, random_scene
from jaxba.solver.options import SolveOptions, checked_options
from jaxba.solver.prepare import DEFAULT_POLICY, set_up
from jaxba.solver.stepwise import Stepwise

SIZES = (
    *((8, slots) for slots in (1024, 2048, 4096, 8192)),
    *((32, slots) for slots in (8192, 16384, 20480, 24576, 28672, 32768)),
    *((48, slots) for slots in (32768, 40960)),
    *((64, slots) for slots in (40960, 49152)),
)
"""Cameras and slots of the grid (structure/padding.py) of problems with 250 to 1,000 observations a
camera."""

# cameras up to which a mapper adjusts all of them by its loss for local adjustments
FEWEST = SIZES[0][0]

LOCAL_SIZES = tuple((cameras, slots) for cameras in (8, 32, 48) for slots in (8192, 16384))
"""Those of the local adjustments of COLMAP's mapper: six free images, and all others that see their
points."""

PAIR_SIZES = (1024, 2048)
"""Slots of the first two images of COLMAP's mapper, which see all points alike."""

# observations of a scene for each slot of its size; others are half of a chunk, or empty
FILLED = 0.84
TRACK = 4.3  # observations of a point, as in BAL's problems and in those of COLMAP on KITTI
FREE = 6  # images that a local adjustment of COLMAP optimises
# of Linux's limit of mappings, up to which compiled programs stay: gigabytes are not needed
KEPT_SHARE = 0.2
MAPPER_LOSS = Loss("soft_l1", 1.0)  # of COLMAP's mapper in the first adjustments after each image


class Kind(NamedTuple):
    """A problem whose programs are compiled."""

    problem: BundleProblem
    loss: Loss


def prepare_programs(
    problems: Iterable[BundleProblem] | None = None,
    policy: str | DampingPolicy = DEFAULT_POLICY,
    options: SolveOptions | None = None,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> int:
    """Compiles programs fully, and keeps them on disk, so that no later solve waits for them.

    Programs belong to a kind of problem (lenses, loss, policy) and to sizes on a coarse grid
    (`SolveOptions.pad`).

    Args:
        problems: those for whose kinds and sizes programs are compiled. None: usual ones, of up to
            64 cameras: with own lenses as in BAL's files, with one lens as in most of COLMAP's
            models, and those of COLMAP's mapper.
        policy: as for `solve`.
        options: as for `solve`. Their loss is not that of the usual problems, which have their own.
        progress: called with the number of kinds that are done, and that of all, before the first
            and after each.

    Returns:
        The number of kinds.

    Raises:
        ValueError: no programs are kept (`keep_programs`), or as `solve`.
        ProblemError: as `solve`."""
    keep_programs_by_default()
    if not programs_are_kept():
        raise ValueError(
            "no programs are kept on disk here: see jaxba.keep_programs and JAXBA_CACHE"
        )
    chosen = checked_options(options)
    kinds = (
        list(usual_kinds())
        if problems is None
        else [Kind(problem, chosen.loss) for problem in problems]
    )
    for number, kind in enumerate(kinds):
        if progress:
            progress(number, len(kinds))
        _compile(kind, policy, chosen)
    if progress:
        progress(len(kinds), len(kinds))
    return len(kinds)


def _compile(kind: Kind, policy: str | DampingPolicy, options: SolveOptions) -> None:
    """Compiles the programs of a kind. They are on disk, so that this process may drop them."""
    padded = True if options.pad is None else options.pad
    setup = set_up(kind.problem, policy, replace(options, loss=kind.loss, pad=padded))
    with numerics(setup.dtype), CompileClock() as clock:
        Stepwise(0, setup, Tolerances(), options.max_iterations, clock).compile()
    process.release_programs(KEPT_SHARE)


def usual_kinds() -> Iterator[Kind]:
    """The kinds that `prepare_programs` compiles without problems."""
    for cameras, slots in SIZES:
        yield Kind(problem_of_size(cameras, slots), Loss())
    for cameras, slots in SIZES:
        problem = _with_one_lens(problem_of_size(cameras, slots))
        yield Kind(problem, Loss())
        yield Kind(_seen_twice(problem), Loss())
        if cameras == FEWEST:
            yield Kind(problem, MAPPER_LOSS)
    for slots in PAIR_SIZES:
        points = int(FILLED * slots / 2)
        pair = random_scene(SceneConfig(2, points, 2 * points), 0)
        yield Kind(_with_one_lens(pair), Loss())
    for cameras, slots in LOCAL_SIZES:
        local = _local(_with_one_lens(problem_of_size(cameras, slots)))
        yield Kind(local, MAPPER_LOSS)
        yield Kind(local, Loss())


def problem_of_size(cameras: int, slots: int) -> BundleProblem:
    """A random scene whose sizes are rounded up to these."""
    observations = int(FILLED * slots)
    return random_scene(SceneConfig(cameras, int(observations / TRACK), observations), 0)


def _local(problem: BundleProblem) -> BundleProblem:
    """The problem with constant lenses, and poses of which the last ones are free."""
    constant = np.arange(max(1, problem.num_cameras - FREE))
    return hold(problem, lenses="all", poses=constant)


def _seen_twice(problem: BundleProblem) -> BundleProblem:
    """The problem with a view of a point that is there twice, as most of COLMAP's models have
    some."""
    return problem.subset(np.append(0, np.arange(problem.num_observations)))


def _with_one_lens(problem: BundleProblem) -> BundleProblem:
    """The problem with one lens of COLMAP's SIMPLE_RADIAL, and two poses constant in part, as
    COLMAP's gauge has it."""
    free = np.zeros((1, LENS_SIZE), bool)
    free[0, :2] = True  # focal length and one coefficient of distortion
    lens = Lenses(np.zeros(problem.num_cameras, np.int32), free)
    return hold(problem.replace(lenses=lens), poses=[0])
