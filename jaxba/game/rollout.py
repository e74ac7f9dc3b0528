"""Plays a damping policy on every scene of a bank, many at a time, each to its end.

A compiled loop over lanes: when a scene ends, its lane starts the next one, so that no lane waits for the slowest
scene.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.damping import DampingPolicy
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.step import lm_step, state_at
from jaxba.lm.termination import converged_in_cost
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces

T = TypeVar("T")

LANES = 128
"""Scenes solved at a time."""

GROUP = 8
"""Scenes that step together on a CPU. Trials and camera rounds of a group last until its slowest scene is done, and
arrays of this size stay in a core's cache: 8 scenes of 10 x 40 took no more time per scene than 64."""


def step_groups(function: Callable[..., T], *arguments: Any, shared: Any = None) -> T:
    """`jax.vmap(function)` in groups of `GROUP`, one after the other, on a CPU; at once elsewhere.

    Under `jax.vmap` the groups stay as large and there are more of them.

    Args:
        function: of one scene. It gets `shared` first if that is not None.
        arguments: with a first axis of scenes.
        shared: arrays that all scenes share. Under `jax.vmap` the function must not close over others.
    """
    if jax.default_backend() != "cpu":
        return _at_once(function, shared, arguments)

    @jax.custom_batching.custom_vmap
    def grouped(shared: Any, arguments: Any) -> T:
        return _grouped(function, shared, arguments)

    @grouped.def_vmap
    def more_groups(size: int, batched: Any, shared: Any, arguments: Any) -> tuple[T, Any]:
        if any(jax.tree.leaves(batched[0])):
            raise ValueError("arrays that all scenes share must not be batched")
        whole = lambda x, own: x if own else jnp.broadcast_to(x, (size, *x.shape))
        flat = jax.tree.map(lambda x, own: whole(x, own).reshape(-1, *x.shape[1 + own :]), arguments, batched[1])
        found = _grouped(function, shared, flat)
        found = jax.tree.map(lambda x: x.reshape(size, -1, *x.shape[1:]), found)
        return found, jax.tree.map(lambda _: True, found)

    return grouped(shared, arguments)


def _at_once(function: Callable[..., T], shared: Any, arguments: Any) -> T:
    one = function if shared is None else functools.partial(function, shared)
    return jax.vmap(one)(*arguments)


def _grouped(function: Callable[..., T], shared: Any, arguments: Any) -> T:
    count = jax.tree.leaves(arguments)[0].shape[0]
    if count <= GROUP:
        return _at_once(function, shared, arguments)
    # whole groups only: `lax.map` would run the remainder at the same time as the groups, and two batched
    # factorisations at a time can deadlock if XLA has two threads
    rows = jnp.minimum(jnp.arange(-(-count // GROUP) * GROUP), count - 1).reshape(-1, GROUP)
    found = lax.map(lambda a: _at_once(function, shared, a), jax.tree.map(lambda x: x[rows], arguments))
    return jax.tree.map(lambda x: x.reshape(-1, *x.shape[2:])[:count], found)


class Trajectories(NamedTuple):
    """Costs and lambdas of a policy on every scene; NumPy arrays."""

    costs: Float[np.ndarray, "scenes iterations"]
    """Accepted cost after each iteration, the start first; constant after the end."""

    dampings: Float[np.ndarray, "scenes iterations"]
    """Lambda of each iteration; zero after the end."""

    iterations: Int[np.ndarray, " scenes"]
    """Linear solves until the end."""

    converged: Bool[np.ndarray, " scenes"]
    """Whether the convergence test ended it, and not the limit."""


class _Lane(NamedTuple):
    scene: Int[Array, " lanes"]
    state: LMState
    policy: Any
    damping: Float[Array, " lanes"]
    iteration: Int[Array, " lanes"]


class _Loop(NamedTuple):
    lane: _Lane
    next_scene: Int[Array, ""]
    costs: Array
    dampings: Array
    iterations: Array
    converged: Array


@for_traces
def play(
    kind: SceneClass, bank: Any, policy: DampingPolicy, options: StepOptions, limit: int, ftol: float = 1e-6
) -> Trajectories:
    """Solves every scene of the bank.

    Args:
        kind: the bank's class.
        bank: scenes with their `ProblemInfo`.
        policy: chooses lambda; a pytree, so that policies of one class share a program.
        options: of the steps.
        limit: largest number of linear solves per scene.
        ftol: relative decrease of an accepted step below which a scene has converged (`converged_in_cost`).
    """
    check_x64(bank.initial_cost.dtype)
    loop = _play(kind, bank, policy, options, limit, jnp.asarray(ftol, bank.initial_cost.dtype))
    found = jax.tree.map(np.asarray, (loop.costs, loop.dampings, loop.iterations, loop.converged))
    costs, dampings, iterations, converged = found
    costs = np.concatenate([np.asarray(bank.initial_cost)[:, None], costs[:-1]], axis=1)
    past = np.arange(limit + 1) > iterations[:-1, None]
    last = np.take_along_axis(costs, iterations[:-1, None], axis=1)
    return Trajectories(np.where(past, last, costs), dampings[:-1], iterations[:-1], converged[:-1])


@functools.partial(jit, static_argnames=("kind", "options", "limit"))
def _play(kind: SceneClass, bank: Any, policy: DampingPolicy, options: StepOptions, limit: int, ftol: Array) -> _Loop:
    layout = class_layout(kind, options)
    count = bank.initial_cost.shape[0]
    lanes = min(LANES, count)

    def fresh(scene: Int[Array, ""]) -> _Lane:
        at = lambda tree: jax.tree.map(lambda x: x[jnp.minimum(scene, count - 1)], tree)  # idle lanes repeat the last
        start = at(bank.scenes)
        policy_state, damping = policy.init(at(bank.info))
        state = state_at(start.cameras, start.points, at(bank.initial_cost), options)
        return _Lane(scene, state, policy_state, damping, jnp.zeros((), jnp.int32))

    def advance(lane: _Lane) -> tuple[_Lane, StepInfo]:
        row = jnp.minimum(lane.scene, count - 1)
        seen = with_scene(layout, bank.scenes.pixels[row], bank.scenes.mask[row])
        state, step = lm_step(seen, lane.state, lane.damping, options, policy.min_gain, lane.iteration)
        policy_state, damping = policy.propose(lane.policy, step)
        return _Lane(lane.scene, state, policy_state, damping, lane.iteration + 1), step

    def body(loop: _Loop) -> _Loop:
        lane, step = step_groups(advance, loop.lane)
        row = jnp.minimum(lane.scene, count)  # idle lanes write to an extra row that is dropped
        converged = jax.vmap(converged_in_cost, in_axes=(0, None))(step, ftol)
        done = converged | (lane.iteration >= limit)
        costs = loop.costs.at[row, lane.iteration - 1].set(step.cost)
        dampings = loop.dampings.at[row, lane.iteration - 1].set(step.damping)
        upcoming = loop.next_scene + jnp.cumsum(done) - 1
        new = jax.vmap(fresh)(upcoming.astype(jnp.int32))
        pick = lambda new, old: jnp.where(done.reshape(-1, *[1] * (old.ndim - 1)), new, old)
        return _Loop(
            jax.tree.map(pick, new, lane),
            (loop.next_scene + jnp.sum(done)).astype(jnp.int32),
            costs,
            dampings,
            loop.iterations.at[row].set(lane.iteration),
            loop.converged.at[row].set(converged),
        )

    dtype = bank.initial_cost.dtype
    loop = _Loop(
        jax.vmap(fresh)(jnp.arange(lanes, dtype=jnp.int32)),
        jnp.asarray(lanes, jnp.int32),
        jnp.zeros((count + 1, limit), dtype),
        jnp.zeros((count + 1, limit), dtype),
        jnp.zeros((count + 1,), jnp.int32),
        jnp.zeros((count + 1,), bool),
    )
    return lax.while_loop(lambda loop: jnp.any(loop.lane.scene < count), body, loop)
