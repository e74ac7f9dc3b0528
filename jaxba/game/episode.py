"""One episode, iteration by iteration: what a viewer and a report of training show of a policy."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Float

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.game.random_scenes import SceneClass, Scenes, make_scenes
from jaxba.game.scene_bank import Bank, info_of, initial_costs, worth_solving
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState, Prices, StepInfo
from jaxba.lm.step import state_at
from jaxba.lm.termination import Tolerances, converged_in_cost
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.solver.iteration import Carry, begin, iterate

TRIES = 64
"""Scenes of which `draw` takes the first that is worth solving; 85% of the default class are."""


class Episode(NamedTuple):
    """An episode; NumPy arrays with a row for the start and every iteration."""

    problem: BundleProblem
    """The start, without what is not observed."""

    cameras: Float[np.ndarray, "states cameras 9"]
    """Cameras of the problem."""

    points: Float[np.ndarray, "states points 3"]
    """Points of the problem."""

    cost: Float[np.ndarray, " states"]
    """Accepted cost, pixels squared."""

    paid: Float[np.ndarray, " states"]
    """Price of all iterations so far (`Prices`), in plain steps."""

    steps: StepInfo
    """Record of the iterations, one fewer than states."""

    converged: bool
    """Whether the convergence test ended it, and not the limit."""


@for_traces
def replay(
    kind: SceneClass,
    bank: Bank,
    scene: int,
    policy: DampingPolicy,
    options: StepOptions,
    limit: int,
    ftol: float = 1e-6,
) -> Episode:
    """Plays a policy on one scene of a bank, as `rollout.play` does, and keeps every iteration.

    Args:
        kind: the bank's class.
        bank: scenes with their `ProblemInfo`.
        scene: number of the scene.
        policy: chooses lambda.
        options: of the steps.
        limit: largest number of linear solves.
        ftol: see `rollout.play`.

    Raises:
        IndexError: there is no such scene.
    """
    if not 0 <= scene < len(bank.initial_cost):
        raise IndexError(f"there is no scene {scene} among {len(bank.initial_cost)}")
    check_x64(bank.initial_cost.dtype)
    one = jax.tree.map(lambda x: x[scene], bank)
    arguments = one.scenes, one.info, one.initial_cost, policy, options, limit
    return _episode(kind, one.scenes, one.info, _played(kind, *arguments, jnp.asarray(ftol, one.initial_cost.dtype)))


@for_traces
def draw(kind: SceneClass, key: Array, scene: int, policy: DampingPolicy, options: StepOptions, limit: int) -> Episode:
    """The same on a random scene: the one with this number, for this key. Other arguments as for `replay`; for a class
    of windows of real problems the scene is one of the family `wide`.

    Raises:
        ValueError: none of `TRIES` scenes of the class is worth solving.
    """
    kind = replace(kind, family="wide") if kind.family == "windows" else kind
    scenes = make_scenes(kind, jax.random.fold_in(key, scene), TRIES)
    costs = initial_costs(kind, scenes)
    info = info_of(kind, scenes, costs, limit)
    rows = worth_solving(kind, info)
    if not len(rows):
        raise ValueError(f"no scene of {kind.cameras} cameras and {kind.points} points is worth solving")
    bank = Bank(scenes, costs, jnp.zeros_like(costs), info, jnp.zeros_like(costs))
    return replay(kind, bank, int(rows[0]), policy, options, limit)


class _Played(NamedTuple):
    start: LMState
    states: LMState  # after each iteration
    steps: StepInfo
    live: Array  # whether the episode had not ended before the iteration
    converged: Array


@functools.partial(jit, static_argnames=("kind", "options", "limit"))
def _played(
    kind: SceneClass,
    scene: Scenes,
    info: ProblemInfo,
    initial: Float[Array, ""],
    policy: DampingPolicy,
    options: StepOptions,
    limit: int,
    ftol: Float[Array, ""],
) -> _Played:
    layout = with_scene(class_layout(kind, options), scene.pixels, scene.mask)
    start = state_at(scene.cameras, scene.points, initial, options)

    def body(loop: tuple[Carry, Array], _: None) -> tuple[Any, Any]:
        carry, live = loop
        carry, step = iterate(layout, carry, policy, Tolerances(), options, limit)
        ended = converged_in_cost(step, ftol)
        return (carry, live & ~ended), (carry.state, step, live, ended)

    first = begin(info, policy, start), jnp.asarray(True)
    _, (states, steps, live, ended) = lax.scan(body, first, length=limit)
    return _Played(start, states, steps, live, jnp.any(live & ended))


def _episode(kind: SceneClass, scene: Scenes, info: ProblemInfo, played: _Played) -> Episode:
    count = int(np.sum(played.live))
    seen = np.asarray(scene.mask).reshape(kind.cameras, kind.points + 1)[:, :-1]
    pixels = np.asarray(scene.pixels).reshape(2, kind.cameras, kind.points + 1)
    cameras, points = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    camera, point = np.nonzero(seen[np.ix_(cameras, points)])
    whole = lambda first, rest: np.concatenate([np.asarray(first)[None], np.asarray(rest)[:count]])
    all_cameras = np.moveaxis(whole(played.start.cameras, played.states.cameras), 1, 2)[:, cameras]
    all_points = np.moveaxis(whole(played.start.points, played.states.points), 1, 2)[:, points]
    price = np.asarray(jax.vmap(Prices.of, in_axes=(None, 0))(info.prices, played.steps))[:count]
    problem = BundleProblem.create(
        all_cameras[0], all_points[0], pixels[:, cameras[camera], points[point]].T, camera, point
    )
    return Episode(
        problem,
        all_cameras,
        all_points,
        whole(played.start.cost, played.steps.cost),
        np.concatenate([[0.0], np.cumsum(price)]),
        jax.tree.map(lambda column: np.asarray(column)[:count], played.steps),
        bool(played.converged),
    )
