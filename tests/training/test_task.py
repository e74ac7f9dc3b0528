"""The baselines that a trained policy is compared with."""

from __future__ import annotations

from dataclasses import asdict

import pytest

from jaxba import make_policy
from jaxba.damping.agent_config import embedded
from jaxba.damping.learned import boldest
from jaxba.training.config import load
from jaxba.training.task import BASELINES, CONSTANT, baseline_policies

EMBEDDED = (
    *(f"game.agent.refinement.{name}={value}" for name, value in asdict(embedded().refinement).items()),
    "game.agent.lens_step=pixels",
)
"""An agent whose step has embedded iterations."""

NAMES = tuple(name for name in BASELINES if name != CONSTANT)


def found(preset: str, *overrides: str):
    config = load(preset, overrides)
    options = config.game.agent.step_options(config.step_options)
    return config, options, baseline_policies(config, options, NAMES)


def test_rules_have_plain_steps_or_the_agents_embedded_iterations():
    config, options, policies = found("default", *EMBEDDED)
    assert tuple(policies) == NAMES
    assert policies["ceres"] == (make_policy("ceres"), config.step_options)
    assert policies["ceres+embedded"] == (make_policy("ceres"), options)
    assert policies["constant:1e-8+embedded"] == (make_policy("constant:1e-8"), options)


def test_what_ships_has_its_own_step_on_the_games_unknowns():
    config, options, policies = found("default", *EMBEDDED, "bank.intrinsics=fixed")
    policy, step = policies["guarded"]
    assert policy == make_policy("guarded")
    assert step == options
    assert policies["learned"] == (make_policy("learned"), config.step_options)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_bold_has_the_guard_and_the_step_of_the_game(preset):
    config, options, policies = found(preset, "game.agent.escalate=0.75")
    assert policies["bold"] == (boldest(config.game.agent), options)
    assert policies["bold"][0].config.escalate == 0.75


def test_without_embedded_iterations_only_plain_steps_and_bold_are_left():
    _, _, policies = found("default")
    assert list(policies) == ["ceres", "classic", "gtsam", "gauss-newton", "schedule", "bold", "learned"]


def test_the_rule_of_the_method_comes_first():
    assert list(found("default", *EMBEDDED, "method=stba")[2]) == ["stba", *NAMES]
