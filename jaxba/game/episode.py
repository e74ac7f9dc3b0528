"""One episode, iteration by iteration: what a viewer and a report of training show of a policy."""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.game.random_scenes import SceneClass, Scenes, make_scenes
from jaxba.game.scene_bank import Bank, info_of, initial_costs, worth_solving
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import lm_step, state_at
from jaxba.lm.termination import converged_in_cost
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces

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

    damping: Float[np.ndarray, " iterations"]
    """Lambda of each iteration, one fewer than states."""

    gain_ratio: Float[np.ndarray, " iterations"]
    """Actual over predicted decrease."""

    accepted: Bool[np.ndarray, " iterations"]
    """Whether the step was accepted."""

    point_iterations: Int[np.ndarray, " iterations"]
    """Embedded point iterations of all candidates."""

    repairs: Int[np.ndarray, " iterations"]
    """Camera rounds, backtracking trials and pattern moves."""

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
    return _episode(kind, one.scenes, _played(kind, *arguments, jnp.asarray(ftol, one.initial_cost.dtype)))


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
    memory, damping = policy.init(info)
    start = state_at(scene.cameras, scene.points, initial, options)

    def body(carry: Any, iteration: Array) -> tuple[Any, Any]:
        state, memory, damping, live = carry
        after, step = lm_step(layout, state, damping, options, policy.min_gain, iteration)
        memory, damping = policy.propose(memory, step)
        ended = converged_in_cost(step, ftol)
        return (after, memory, damping, live & ~ended), (after, step, live, ended)

    _, (states, steps, live, ended) = lax.scan(
        body, (start, memory, damping, jnp.asarray(True)), jnp.arange(limit, dtype=jnp.int32)
    )
    return _Played(start, states, steps, live, jnp.any(live & ended))


def _episode(kind: SceneClass, scene: Scenes, played: _Played) -> Episode:
    count = int(np.sum(played.live))
    seen = np.asarray(scene.mask).reshape(kind.cameras, kind.points + 1)[:, :-1]
    pixels = np.asarray(scene.pixels).reshape(2, kind.cameras, kind.points + 1)
    cameras, points = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    camera, point = np.nonzero(seen[np.ix_(cameras, points)])
    whole = lambda first, rest: np.concatenate([np.asarray(first)[None], np.asarray(rest)[:count]])
    all_cameras = np.moveaxis(whole(played.start.cameras, played.states.cameras), 1, 2)[:, cameras]
    all_points = np.moveaxis(whole(played.start.points, played.states.points), 1, 2)[:, points]
    problem = BundleProblem.create(
        all_cameras[0], all_points[0], pixels[:, cameras[camera], points[point]].T, camera, point
    )
    own = lambda name: np.asarray(getattr(played.steps, name))[:count]
    return Episode(
        problem,
        all_cameras,
        all_points,
        whole(played.start.cost, played.steps.cost),
        own("damping"),
        own("gain_ratio"),
        own("accepted"),
        own("point_iterations"),
        own("repairs"),
        bool(played.converged),
    )
