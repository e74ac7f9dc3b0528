"""Solver names, the same in all commands, tables and files:
`[method+]policy[+refineK|+embedded][@dtype]`.

Another library as a solver (a peer) is named `pyceres:MODE`."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Any, Literal, cast, get_args

from jaxba.damping import DampingPolicy, brings_step, make_policy
from jaxba.damping.agent_config import embedded
from jaxba.damping.policy import trained_step
from jaxba.damping.registry import OWN, SUFFIX
from jaxba.problem.options import EMBEDDED, Refinement, StepOptions
from jaxba.solver.methods import DEFAULT_METHOD, METHODS, make_method
from jaxba.solver.options import Dtype, SolveOptions
from jaxba.typing import InputError

DTYPES = get_args(Dtype)  # known floating point types; the first is the default

Repairs = Literal["none", "trials", "all"]
"""What is done about a step that is not good enough: nothing; shorter steps; camera rounds and
pattern moves, too."""

# suffix of a peer's mode with inner iterations, the peer's own embedded iterations
INNER = "-inner"

PEERS = {"pyceres": ("dense", "sparse", "iterative", f"dense{INNER}", f"sparse{INNER}")}
"""Peer libraries and their modes."""


@dataclass(frozen=True)
class SolverName:
    """A parsed solver name; `str` returns its shortest form."""

    policy: str
    """Name of the damping policy, see `jaxba.damping.make_policy`; empty for a peer."""

    refine_points: int | None = 0
    """Number of embedded point iterations, without any other refinement. None: the step that a
    policy brings (a learned one that of its training), or for a rule (`RULE+embedded`) all embedded
    iterations."""

    dtype: Dtype = DTYPES[0]
    """Floating point type."""

    method: str = DEFAULT_METHOD
    """Name of the optimisation method, see `jaxba.methods`."""

    peer: str = ""
    """`LIBRARY:MODE` if another library solves, by its own damping rule."""

    def __str__(self) -> str:
        if self.peer:
            return self.peer
        refinement = ""
        if self.refine_points is None:
            refinement = "" if brings_step(self.policy) else "+embedded"
        elif self.refine_points or brings_step(self.policy):
            refinement = f"+refine{self.refine_points}"
        method = "" if self.method == DEFAULT_METHOD else f"{self.method}+"
        dtype = "" if self.dtype == DTYPES[0] else f"@{self.dtype}"
        return f"{method}{self.policy}{refinement}{dtype}"

    def build(self) -> tuple[DampingPolicy, SolveOptions]:
        """The policy, and the options of the solve. Raises InputError: as `make_policy`,
        `make_method`."""
        policy = make_policy(self.policy)
        step = trained_step(policy)
        if self.refine_points is not None:
            step = replace(step, refinement=Refinement(points=self.refine_points))
        elif not brings_step(self.policy):
            step = embedded().step_options(StepOptions())
        return policy, SolveOptions(
            method=self.method,
            refinement=step.refinement,
            coordinates=step.coordinates,
            dtype=self.dtype,
        )


def adjusted(
    policy: Any, options: SolveOptions, repairs: Repairs | None, min_gain: float | None
) -> tuple[DampingPolicy, SolveOptions]:
    """What `SolverName.build` returns, with other repairs and another smallest gain ratio. None: as
    they are. Raises ValueError: `min_gain` is not in [0, 1)."""
    if repairs is not None:
        points = 0 if options.refinement is None else options.refinement.points
        whole = replace(EMBEDDED, points=points)
        found = {
            "none": Refinement(points=points),
            "trials": replace(whole, camera_rounds=0, pattern_moves=0),
        }
        options = replace(options, refinement=found.get(repairs, whole))
    if min_gain is not None:
        if not 0 <= min_gain < 1:
            raise ValueError(f"min_gain must be at least 0 and below 1, is {min_gain}")
        agent = getattr(policy, "config", None)
        changed = (
            {"min_gain": min_gain}
            if agent is None
            else {"config": replace(agent, min_gain=min_gain)}
        )
        policy = replace(policy, **changed)
    return policy, options


def split_refinement(name: str) -> tuple[str, int | None, bool]:
    """The name of a policy without `+refineK` or `+embedded` at its end. Returns the rest of the
    name; the number of embedded point iterations, None for the full refinement, as in
    `SolverName.refine_points`; and whether the name says it. What it does not say is 0."""
    match = _REFINEMENT.fullmatch(name)
    if match is None:
        return name, 0, False
    return match[1], None if match[2] is None else int(match[2]), True


_REFINEMENT = re.compile(r"(.*)\+(?:refine(\d+)|embedded)", re.DOTALL)


def parse_policy(name: str) -> SolverName:
    """The solver with plain LM in float64 of a name `policy[+refineK|+embedded]`. The policy itself
    is not checked."""
    policy, refine, stated = split_refinement(name)
    return SolverName(policy, None if brings_step(policy) and not stated else refine)


def resolve_policy(name: str, options: SolveOptions) -> tuple[DampingPolicy, SolveOptions]:
    """The policy of a name `policy[+refineK|+embedded]`, and the options with the refinement that
    the name states. Coordinates that the options give take precedence over those that come with
    `+embedded`. Raises ValueError: the options have another refinement than the name. Raises
    InputError: as `make_policy`."""
    policy, _, stated = split_refinement(name)
    if not stated:
        return make_policy(name), options
    built, own = parse_policy(name).build()
    if options.refinement not in (None, own.refinement):
        raise ValueError(
            f"policy {name!r} states its refinement: leave out that of the options, or name "
            f"{policy!r}"
        )
    return built, replace(
        options, refinement=own.refinement, coordinates=options.coordinates or own.coordinates
    )


def parse_solver(name: str) -> SolverName:
    """Parses a solver name. Raises InputError: an unknown method, mode, type or policy, or a
    malformed name."""
    library, _, mode = name.strip().partition(":")
    if library in PEERS:
        if mode not in PEERS[library]:
            raise InputError(
                f"unknown mode {mode!r} in {name!r}; known: {', '.join(PEERS[library])}"
            )
        return SolverName("", peer=name.strip())
    # the path of a file may contain `+` and `@`
    named = re.match(rf"(.*\{SUFFIX}|{OWN})(.*)", name.strip(), re.DOTALL)
    path, rest = named.groups() if named else ("", name.strip())
    prefix, at, dtype = rest.partition("@")
    prefix, refine, stated = split_refinement(prefix)
    parts = prefix.split("+")
    if path:
        method, plus, file = path.partition("+")
        known = bool(plus) and method.partition(":")[0] in METHODS
        parts[0] = (file if known else path) + parts[0]
        parts = [method, *parts] if known else parts
    # a `+` in an exponent belongs to the number: constant:1e+2
    merged: list[str] = []
    for part in parts:
        if merged and not merged[-1].endswith(SUFFIX) and re.search(r":\d*\.?\d*[eE]$", merged[-1]):
            merged[-1] += "+" + part
        else:
            merged.append(part)
    method = merged.pop(0) if len(merged) > 1 else DEFAULT_METHOD
    if len(merged) != 1 or not merged[0]:
        raise InputError(
            f"{name!r} is no solver; the form is [method+]policy[+refineK|+embedded][@dtype]"
        )
    try:
        make_method(method)
    except InputError as error:
        raise InputError(f"{error} (in {name!r})") from None
    if at and dtype not in DTYPES:
        raise InputError(f"unknown type {dtype!r} in {name!r}; known: {', '.join(DTYPES)}")
    make_policy(merged[0])
    if brings_step(merged[0]) and not stated:
        refine = None
    return SolverName(merged[0], refine, cast(Dtype, dtype or DTYPES[0]), method)
