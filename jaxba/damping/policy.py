"""The protocol of damping policies: a pair of pure functions, like an optax transform."""

from __future__ import annotations

from typing import Any, NamedTuple, Protocol, runtime_checkable

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Bool, Float, Int

from jaxba.lm.records import StepInfo
from jaxba.problem.options import StepOptions
from jaxba.typing import AnyArray


class ProblemInfo(NamedTuple):
    """What a policy knows before the first iteration."""

    cost: Float[Array, ""]
    """Cost at the start, pixels^2."""

    observations: Int[Array, ""]
    """Number of observations."""

    cameras: Int[Array, ""]
    """Number of cameras that are observed."""

    points: Int[Array, ""]
    """Number of points that are observed."""

    unit: Float[Array, ""]
    """Largest Hessian diagonal under identity scaling, 1 under diagonal scaling."""

    focal: Float[Array, ""]
    """Median focal length, pixels."""

    max_iterations: Int[Array, ""]
    """Limit of iterations."""

    @classmethod
    def of(
        cls,
        cost: Float[Array, ""],
        observations: Any,
        points: Any,
        seen: Bool[AnyArray, " cameras"],
        focal: Float[AnyArray, " cameras"],
        max_iterations: Any,
        unit: Any = 1.0,
    ) -> ProblemInfo:
        """The fields, of their types: `seen` says which cameras are observed, `focal` has their
        focal lengths."""

        def count(n):
            return jnp.asarray(n, jnp.int32)

        return cls(
            cost=cost,
            observations=count(observations),
            cameras=count(jnp.sum(seen)),
            points=count(points),
            unit=jnp.asarray(unit, cost.dtype),
            focal=jnp.nanmedian(jnp.where(seen, jnp.abs(focal), jnp.nan)),
            max_iterations=count(max_iterations),
        )


@runtime_checkable
class DampingPolicy(Protocol):
    """Chooses lambda for every iteration.

    A policy is a frozen dataclass and a pytree (`jaxba.register_pytree`): its numbers are traced,
    so that changing one never recompiles, and its class selects the code. Both functions are pure
    and jittable.

    A policy may have a third function: `step_options(base)` gives the `StepOptions` that it was
    made for, which `solve` uses unless its options say otherwise."""

    @property
    def min_gain(self) -> Any:
        """A step whose gain ratio does not exceed this is rejected."""
        ...

    def init(self, info: ProblemInfo) -> tuple[Any, Float[Array, ""]]:
        """State and lambda of the first iteration."""
        ...

    def propose(self, state: Any, step: StepInfo) -> tuple[Any, Float[Array, ""]]:
        """State and lambda of the next iteration, after the step that used the last lambda."""
        ...


def trained_step(policy: DampingPolicy) -> StepOptions:
    """The step that a policy was made for: that of its method `step_options`, if it has one, else a
    plain step."""
    made_for = getattr(policy, "step_options", None)
    return StepOptions() if made_for is None else made_for(StepOptions())


_PARTS = ("min_gain", "init", "propose")  # what every policy has (`DampingPolicy`)


def check_policy(policy: object) -> None:
    """Raises a ValueError that says what a policy lacks."""
    missing = [name for name in _PARTS if not hasattr(policy, name)]
    if isinstance(policy, type) or len(missing) == len(_PARTS):
        raise ValueError(f"policy must be the name of a policy or a policy, not {policy!r}")
    name = type(policy).__name__
    if missing:
        raise ValueError(
            f"policy {name} has no {' and no '.join(missing)} (see jaxba.DampingPolicy)"
        )
    structure = jax.tree.structure(policy)
    if jax.tree_util.all_leaves([policy]):  # a policy may have no numbers
        raise ValueError(
            f"policy {name} is no pytree: decorate its dataclass with jaxba.register_pytree"
        )
    for other, seen in _structures.items():
        if other is not type(policy) and seen == structure:  # see `register_pytree`
            raise ValueError(
                f"policy {name} cannot be told from policy {other.__name__} of this process, whose "
                "compiled program "
                "might run in its place: decorate it with jaxba.register_pytree, not with JAX's "
                "register_dataclass"
            )
    _structures[type(policy)] = structure


# the last structure of a policy of each class, for `check_policy`
_structures: dict[type, Any] = {}
