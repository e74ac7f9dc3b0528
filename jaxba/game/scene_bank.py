"""The bank of scenes that the game is played on, and the best known cost of each.

Scenes are made in one compiled program and solved by a portfolio of hand-written rules with
embedded point iterations. Those that no rule solves, that are solved at the start or that are
numerically meaningless are left out. Reaching the best known cost ends an episode in training. No
observation of a policy depends on it."""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.damping import ProblemInfo, make_policy
from jaxba.game.random_scenes import SceneClass, Scenes, make_scenes
from jaxba.game.rollout import alike, play
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.game.windows import read_windows
from jaxba.io.files import StrPath
from jaxba.model.linearize import cost
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.losses import Loss
from jaxba.problem.options import Intrinsics, Refinement, StepOptions, check_count
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import for_traces
from jaxba.typing import InputError

# rules whose lowest cost is the best known one, each with point iterations
PORTFOLIO = ("ceres", "gtsam", "theseus")
PORTFOLIO_ITERATIONS = 50  # largest number of linear solves of each rule
# relative decrease of an accepted step that ends a rule's run, a tenth of the solver's default
PORTFOLIO_FTOL = 1e-7

MIN_RATIO = 1.01
MAX_RATIO = 1e6
"""Range of initial over best cost of a usable scene. The ratio of four of six COLMAP models is
between 1.04 and 1.1."""

# least best cost per observation of a usable scene, pixels squared: below, rounding dominates
SMALLEST_COST = 1e-9
MIN_OBSERVATIONS = 30  # smallest number of observations of a scene that is solved at all

MAX_ERROR_ANGLE = 0.2
"""Largest RMS error of a solved scene over the focal length; above it points are close to a
camera's plane."""

PAPER_ERROR_ANGLE = 1.0  # the same for the family `paper`, whose starts are far away
# iterations in which at least one rule must come within 1e-3 of the best cost of a usable scene
EASY_ENOUGH = 40


class Bank(NamedTuple):
    """Scenes and what is known about them. A row is a scene."""

    scenes: Scenes
    initial_cost: Float[Array, " scenes"]
    best_cost: Float[Array, " scenes"]
    info: ProblemInfo  # a field per scene
    # of Ceres' rule with the portfolio's steps, to the game's tolerance
    ceres_iterations: Float[Array, " scenes"]


def info_of(
    kind: SceneClass, scenes: Scenes, initial: Float[Array, " scenes"], limit: int
) -> ProblemInfo:
    """What a policy knows about each scene before the first iteration."""

    def one(scene: Scenes, cost: Array) -> ProblemInfo:
        grid = scene.mask.reshape(kind.cameras, kind.points + 1)
        seen = jnp.any(grid, axis=1)
        points = jnp.sum(jnp.any(grid, axis=0))
        return ProblemInfo.of(cost, jnp.sum(grid), points, seen, scene.cameras[6], limit)

    return jax.vmap(one)(scenes, initial)


def worth_solving(kind: SceneClass, info: ProblemInfo) -> Int[np.ndarray, " kept"]:
    """Rows of the scenes that have enough observations, and a start that is not too far away."""
    error = jnp.sqrt(2 * info.cost / jnp.maximum(info.observations, 1))
    largest = PAPER_ERROR_ANGLE if kind.family == "paper" else MAX_ERROR_ANGLE
    return np.flatnonzero((error < largest * info.focal) & (info.observations >= MIN_OBSERVATIONS))


@functools.partial(jit, once=True, static_argnames=("kind",))
def initial_costs(kind: SceneClass, scenes: Scenes) -> Float[Array, " scenes"]:
    """The cost of every start, pixels squared."""
    layout = class_layout(kind, StepOptions())

    def one(scene: Scenes) -> Array:
        return cost(
            with_scene(layout, scene.pixels, scene.mask), scene.cameras, scene.points, Loss()
        )

    return jax.lax.map(one, scenes, batch_size=256)


@dataclass(frozen=True)
class BankConfig:
    """How many scenes of which kind."""

    kind: SceneClass = field(default_factory=SceneClass)
    """Their class."""

    scenes: int = 12000
    """Scenes drawn; the usable ones are kept."""

    refine_points: int = 3
    """Embedded point iterations of the portfolio."""

    problems: tuple[str, ...] = ()
    """Real problems, from which scenes of the family `windows` are cut."""

    intrinsics: Intrinsics = "free"
    """Whether focal lengths and distortions are optimised in the game's solves."""

    @property
    def options(self) -> StepOptions:
        """Of the portfolio's steps."""
        return StepOptions(
            refinement=Refinement(points=self.refine_points), intrinsics=self.intrinsics
        )

    def __post_init__(self) -> None:
        check_count("refine_points", self.refine_points, 0)
        check_count("scenes", self.scenes, 1)
        if bool(self.problems) != (self.kind.family == "windows"):
            raise ValueError(
                "problems and scenes of the family windows go together: only one of them is given"
            )
        _ = self.options  # raises ValueError if impossible


@for_traces
def solve_scenes(
    kind: SceneClass,
    scenes: Scenes,
    options: StepOptions,
    limit: int,
    rules: Sequence[str] = PORTFOLIO,
    on_rule: Callable[[str], None] = lambda _: None,
    tolerance: float = 1e-3,
) -> tuple[Bank, Bool[np.ndarray, " scenes"]]:
    """Solves scenes with every rule, and tells which of them are usable. `limit` is that of an
    episode, for the scenes' `ProblemInfo`; `on_rule` is called with the name of a rule of the
    portfolio when it begins; `tolerance` is the one to which the first rule's iterations are
    counted. Raises InputError: none of the scenes is worth solving."""
    initial = initial_costs(kind, scenes)
    info = info_of(kind, scenes, initial, limit)
    keep = worth_solving(kind, info)
    if not len(keep):
        raise InputError(
            f"none of {len(info.cost)} scenes of {_shape(kind)} is worth solving: draw more"
        )
    scenes, initial, info = jax.tree.map(lambda x: x[keep], (scenes, initial, info))
    bank = Bank(scenes, initial, initial, info, jnp.zeros_like(initial))
    runs = {}
    for rule, (policy, step) in alike(
        {rule: (make_policy(rule), options) for rule in rules}
    ).items():
        on_rule(rule)
        runs[rule] = play(kind, bank, policy, step, PORTFOLIO_ITERATIONS, PORTFOLIO_FTOL)
    best = np.min([run.costs[:, -1] for run in runs.values()], axis=0)
    to_best = reach(runs[rules[0]].costs, best, tolerance)
    bank = bank._replace(best_cost=jnp.asarray(best), ceres_iterations=jnp.asarray(to_best))
    ratio = np.asarray(initial) / best
    soonest = np.min([reach(run.costs, best, 1e-3) for run in runs.values()], axis=0)
    floor = SMALLEST_COST * np.asarray(info.observations)
    usable = (ratio > MIN_RATIO) & (ratio < MAX_RATIO) & (soonest <= EASY_ENOUGH) & (best > floor)
    return bank, usable


def _shape(kind: SceneClass) -> str:
    return f"{kind.cameras} cameras x {kind.points} points"


class Split(NamedTuple):
    """Scenes to train on, and held-out scenes."""

    train: Bank
    held_out: Bank


@for_traces
def make_split(
    config: BankConfig,
    key: Array,
    options: StepOptions,
    limit: int,
    report: Callable[[str], None] = lambda _: None,
    tolerance: float = 1e-3,
    problems: Sequence[StrPath | BundleProblem] = (),
) -> Split:
    """Draws and solves scenes, and splits the usable ones. The same key gives the same scenes.
    `options` are those of the portfolio's steps, `limit` is that of an episode; `report` is called
    with a line when something long begins. The game's tolerance does not change which are usable.
    Windows are cut from `problems`, in memory or files, instead of those that `config` names.
    Raises InputError: no scene would be left to train on."""
    kind = config.kind
    count = config.scenes
    key = jax.random.fold_in(key, 0)
    where = _shape(kind)

    def on_rule(rule):
        return report(f"{count} scenes of {where}: {rule}")

    def solved(scenes):
        return solve_scenes(kind, scenes, options, limit, PORTFOLIO, on_rule, tolerance)

    if kind.family == "windows":
        seed = int(jax.random.randint(key, (), 0, 2**31 - 1))
        banks = [
            select(*solved(scenes))
            for scenes in read_windows(problems or config.problems, kind, count, seed)
        ]
    else:
        made, usable = solved(make_scenes(kind, key, count))
        rows = np.flatnonzero(usable)
        held = held_out_count(len(rows))
        banks = [select(made, part) for part in (rows[held:], rows[:held])]
    if any(not len(bank.initial_cost) for bank in banks):
        usable = sum(len(bank.initial_cost) for bank in banks)
        raise InputError(f"only {usable} of {count} scenes of {where} are usable: draw more")
    return Split(*banks)


HELD_OUT = 0.1
ENOUGH = 200
MOST_HELD_OUT = 1 / 3
"""Fraction of usable scenes held out; more up to a number whose mean says something, at most the
last one."""


def held_out_count(usable: int) -> int:
    """Number of held-out scenes among the usable ones."""
    return max(1, round(HELD_OUT * usable), min(ENOUGH, int(MOST_HELD_OUT * usable)))


def reach(
    costs: Float[np.ndarray, "scenes iterations"],
    best: Float[np.ndarray, " scenes"],
    tolerance: float,
) -> np.ndarray:
    """Iterations until the accepted cost is at most `best (1 + tolerance)`; infinite if it never
    is."""
    reached = costs <= best[:, None] * (1 + tolerance)
    return np.where(reached.any(axis=1), reached.argmax(axis=1), np.inf)


@for_traces
def select(bank: Bank, rows: Int[np.ndarray, " kept"] | Bool[np.ndarray, " scenes"]) -> Bank:
    """The scenes of these rows."""
    return jax.tree.map(lambda x: x[jnp.asarray(rows)], bank)
