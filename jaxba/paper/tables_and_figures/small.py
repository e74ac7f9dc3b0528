"""Table: the limit of small problems."""

from __future__ import annotations

from dataclasses import dataclass, replace

from jaxba.bench.sources import Source
from jaxba.bench.tables import number
from jaxba.damping import DampingPolicy
from jaxba.paper import agents, claims
from jaxba.paper.markdown import Section, disagreements
from jaxba.paper.rows import Row
from jaxba.paper.runner import Method, Runner, method_named
from jaxba.paper.tables_and_figures import common
from jaxba.paper.tables_and_figures.common import CERES, CLASSIC, Labelled, Lines, TableOrFigure
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.scenes import SceneConfig, random_scene
from jaxba.solver.options import SolveOptions

PAPER_SIZE = 5
"""Cameras and points of the paper's small problem."""

WHY = (
    "our scenes and their starts are our own random ones, since the paper gives none; a solve here calls Python after "
    "each iteration, and a compiled one has less overhead; our agents are smaller than the paper's, which ran on a GPU."
)


@dataclass(frozen=True)
class SmallScene(Source):
    """A random scene with as many points as cameras, in which every camera observes every point."""

    size: int = PAPER_SIZE
    """Number of cameras and of points."""

    seed: int = 0
    """Seed of the scene."""

    def read(self) -> BundleProblem:
        """Generates the scene. Its start has the true focal lengths."""
        n = self.size
        config = SceneConfig(n, n, n * n, trajectory="orbit", min_depth=4.0, max_depth=16.0, start_focal=0.0)
        return random_scene(config, self.seed)


def _sources(runner: Runner, size: int) -> list[SmallScene]:
    config = runner.config
    seeds = range(config.seed, config.seed + config.small_scenes)
    return [SmallScene(f"small-{size}-{seed}", "small", f"{size} x {size}", size, seed) for seed in seeds]


def _known_lens(method: Method) -> Method:
    """The same method with constant focal lengths and distortions."""

    def build(seed: int) -> tuple[DampingPolicy, SolveOptions]:
        policy, options = method.build(seed)
        return policy, replace(options, intrinsics="fixed", linear_solver="explicit")

    return replace(method, build=build)


def _rows(runner: Runner, size: int) -> list[Labelled]:
    paper = lambda iterations: iterations if size == PAPER_SIZE else None
    return [
        Labelled("classic", _known_lens(method_named(CLASSIC)), paper(5.0)),
        Labelled("Ceres' rule", _known_lens(method_named(CERES))),
        Labelled("ours: agent of this run", _known_lens(runner.agent(agents.OURS)), paper(4.0)),
        Labelled("ours: shipped policy, lambda alone", _known_lens(method_named("learned-driver")), paper(4.0)),
    ]


def _run(runner: Runner) -> None:
    for size in runner.config.small:
        runner.solve(_sources(runner, size), common.methods(_rows(runner, size)), repeats=1)


def _section(runner: Runner) -> Section:
    body = [
        "Poses and points are unknown, the lens is known: with the nine unknowns of a BAL camera, five cameras and "
        "five points would be underdetermined (50 equations for 53 unknowns, without the gauge)."
    ]
    found = []
    for size in runner.config.small:
        sources = _sources(runner, size)
        lines = Lines(runner, _rows(runner, size), sources)
        if size == PAPER_SIZE:
            found += _claims(lines.known(agents.OURS.name), lines.known(CLASSIC))
        if not lines.any:
            body.append(f"**{size} x {size}**: {common.NOT_YET}")
            continue
        body.append(f"**{size} cameras, {size} points**, {len(sources)} scenes:")
        body.append(lines.table(with_time=True))
    body.append(disagreements(found, WHY))
    return Section("Small problems", tuple(body), tuple(found))


def _claims(ours: Row | None, classic: Row | None) -> list[claims.Claim]:
    """The claims on five cameras and five points."""
    ratio = claims.ratio_claim("5 x 5: ours takes four fifths of classic's iterations", 0.8, ours, classic)
    text, paper = "5 x 5: ours takes longer in seconds, for the time of inference", "+0.5 s"
    if ours is None or classic is None:
        return [ratio, claims.Claim(text, paper, "-", "not run")]
    longer = 1e3 * (ours.seconds - classic.seconds)
    detail = f"{longer:+.1f} ms ({number(1e3 * ours.seconds)} / {number(1e3 * classic.seconds)} ms)"
    return [ratio, claims.Claim(text, paper, detail, "reproduced" if longer > 0 else "not")]


SMALL = TableOrFigure("small", "Table: the limit of small problems, 5 x 5", _run, _section)
