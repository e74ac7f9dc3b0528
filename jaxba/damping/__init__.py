"""Damping policies: who chooses lambda."""

from jaxba.damping.policy import DampingPolicy, ProblemInfo
from jaxba.damping.registry import POLICIES, UnknownPolicyError, make_policy
from jaxba.damping.rules import Ceres, Classic, Geometric, Schedule
from jaxba.damping.safeguard import Safeguard

__all__ = [
    "POLICIES",
    "Ceres",
    "Classic",
    "DampingPolicy",
    "Geometric",
    "ProblemInfo",
    "Safeguard",
    "Schedule",
    "UnknownPolicyError",
    "make_policy",
]
