"""Plays a damping policy on every scene of a bank, many at a time, each to its end.

A compiled loop over lanes: when a scene ends, its lane starts the next one, so that no lane waits
for the slowest scene."""

from __future__ import annotations

import functools
from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array, lax
from jaxtyping import Bool, Float, Int

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_layout import class_layout, with_scene
from jaxba.lm.records import LMState, StepInfo
from jaxba.lm.termination import Tolerances, converged_in_cost
from jaxba.problem.options import StepOptions
from jaxba.runtime.jit import jit
from jaxba.runtime.numerics import check_x64, for_traces
from jaxba.solver.iteration import Carry, begin, iterate
from jaxba.solver.lanes import refill
from jaxba.typing import register_pytree


@register_pytree
@dataclass(frozen=True)
class OneOf:
    """Several policies as one, so that they share compiled programs: that of a number, which is
    traced, is asked."""

    policies: tuple[Any, ...]
    number: Any

    @property
    def min_gain(self) -> Array:
        """See `DampingPolicy`."""
        return jnp.stack([jnp.asarray(one.min_gain) for one in self.policies])[self.number]

    def init(self, info: ProblemInfo) -> tuple[Any, Array]:
        """See `DampingPolicy`."""
        states, dampings = zip(*(one.init(info) for one in self.policies), strict=True)
        return states, jnp.stack(dampings)[self.number]

    def propose(self, state: tuple[Any, ...], step: StepInfo) -> tuple[Any, Array]:
        """See `DampingPolicy`."""

        def ask(k: int, states: tuple[Any, ...]) -> tuple[Any, Array]:
            after, damping = self.policies[k].propose(states[k], step)
            return (*states[:k], after, *states[k + 1 :]), damping

        asked = [lambda states, k=k: ask(k, states) for k in range(len(self.policies))]
        return lax.switch(self.number, asked, state)


def alike(
    policies: Mapping[str, tuple[DampingPolicy, StepOptions]],
) -> dict[str, tuple[DampingPolicy, StepOptions]]:
    """Policies with their steps; those with equal steps have one structure, so that a function
    compiles once."""
    kinds: dict[StepOptions, dict[Hashable, DampingPolicy]] = {}
    for policy, options in policies.values():
        kinds.setdefault(options, {}).setdefault(_kind(policy), policy)
    found = {}
    for name, (policy, options) in policies.items():
        same = kinds[options]
        number = list(same).index(_kind(policy))
        one = OneOf(
            tuple(policy if k == number else x for k, x in enumerate(same.values())),
            jnp.asarray(number),
        )
        found[name] = (one if len(same) > 1 else policy), options
    return found


def _kind(policy: DampingPolicy) -> Hashable:
    leaves, structure = jax.tree.flatten(policy)
    return structure, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)


LANES = 128  # scenes solved at a time


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


@for_traces
def play(
    kind: SceneClass,
    bank: Any,
    policy: DampingPolicy,
    options: StepOptions,
    limit: int,
    ftol: float = 1e-6,
) -> Trajectories:
    """Solves every scene of the bank.

    Args:
        kind: the bank's class.
        bank: scenes with their `ProblemInfo`.
        policy: chooses lambda; a pytree, so that policies of one class share a program.
        options: of the steps.
        limit: largest number of linear solves per scene.
        ftol: relative decrease of an accepted step below which a scene has converged
            (`converged_in_cost`)."""
    check_x64(bank.initial_cost.dtype)
    played = _play(kind, bank, policy, options, limit, jnp.asarray(ftol, bank.initial_cost.dtype))
    found: Trajectories = jax.tree.map(np.asarray, played)
    costs = np.concatenate([np.asarray(bank.initial_cost)[:, None], found.costs], axis=1)
    past = np.arange(limit + 1) > found.iterations[:, None]
    last = np.take_along_axis(costs, found.iterations[:, None], axis=1)
    return found._replace(costs=np.where(past, last, costs))


@functools.partial(jit, static_argnames=("kind", "options", "limit"))
def _play(
    kind: SceneClass,
    bank: Any,
    policy: DampingPolicy,
    options: StepOptions,
    limit: int,
    ftol: Array,
) -> Trajectories:
    """`Trajectories` of JAX arrays; costs without the start."""
    layout = class_layout(kind, options)
    count = bank.initial_cost.shape[0]

    def fresh(scene: Int[Array, ""]) -> Carry:
        def at(tree):
            return jax.tree.map(lambda x: x[scene], tree)

        start = at(bank.scenes)
        state = LMState(start.cameras, start.points, at(bank.initial_cost))
        return begin(at(bank.info), policy, state)

    def advance(
        scene: Int[Array, ""], carry: Carry
    ) -> tuple[Carry, tuple[StepInfo, Array], Bool[Array, ""]]:
        seen = with_scene(layout, bank.scenes.pixels[scene], bank.scenes.mask[scene])
        carry, step = iterate(seen, carry, policy, Tolerances(), options, limit)
        converged = converged_in_cost(step, ftol)
        return carry, (step, converged), converged | (carry.iteration >= limit)

    def note(found: Any, scene: Array, carry: Carry, record: Any, _: Array) -> Any:
        (step, converged) = record
        iteration = carry.iteration
        return found._replace(
            costs=found.costs.at[scene, iteration - 1].set(step.cost, mode="drop"),
            dampings=found.dampings.at[scene, iteration - 1].set(step.damping, mode="drop"),
            iterations=found.iterations.at[scene].set(iteration, mode="drop"),
            converged=found.converged.at[scene].set(converged, mode="drop"),
        )

    rows = np.zeros((count, limit), bank.initial_cost.dtype)
    nothing = Trajectories(rows, rows, np.zeros(count, np.int32), np.zeros(count, bool))
    return refill(
        count, count, min(LANES, count), fresh, advance, note, jax.tree.map(jnp.asarray, nothing)
    )
