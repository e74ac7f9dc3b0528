"""Damping policies: who chooses lambda."""

from jaxba.damping.learned import AgentPolicy, LearnedPolicy
from jaxba.damping.policy import DampingPolicy, ProblemInfo
from jaxba.damping.policy_file import load_policy, save_policy
from jaxba.damping.registry import LEARNED, POLICIES, brings_step, is_learned, make_policy
from jaxba.damping.rules import Ceres, Classic, Geometric, Schedule
