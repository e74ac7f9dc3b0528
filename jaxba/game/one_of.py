"""Several damping policies as one, so that they share compiled programs."""

from __future__ import annotations

from collections.abc import Hashable, Mapping
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
from jax import Array, lax

from jaxba.damping import DampingPolicy, ProblemInfo
from jaxba.lm.records import StepInfo
from jaxba.problem.options import StepOptions
from jaxba.typing import register_pytree


@register_pytree
@dataclass(frozen=True)
class OneOf:
    """The policy of a number, which is traced. Only this one is asked."""

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


def alike(policies: Mapping[str, tuple[DampingPolicy, StepOptions]]) -> dict[str, tuple[DampingPolicy, StepOptions]]:
    """Policies with their steps; those with equal steps have one structure, so that a function compiles once."""
    kinds: dict[StepOptions, dict[Hashable, DampingPolicy]] = {}
    for policy, options in policies.values():
        kinds.setdefault(options, {}).setdefault(_kind(policy), policy)
    found = {}
    for name, (policy, options) in policies.items():
        same = kinds[options]
        number = list(same).index(_kind(policy))
        one = OneOf(tuple(policy if k == number else x for k, x in enumerate(same.values())), jnp.asarray(number))
        found[name] = (one if len(same) > 1 else policy), options
    return found


def _kind(policy: DampingPolicy) -> Hashable:
    leaves, structure = jax.tree.flatten(policy)
    return structure, tuple((jnp.shape(leaf), jnp.result_type(leaf)) for leaf in leaves)
