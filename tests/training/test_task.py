"""The baselines that a trained policy is compared with."""

from __future__ import annotations

import pytest

from jaxba import make_policy
from jaxba.damping.learned import always
from jaxba.training.config import load
from jaxba.training.task import BASELINES, CONSTANT, baseline_policies

NAMES = tuple(name for name in BASELINES if name != CONSTANT)


def found(preset: str, *overrides: str):
    config = load(preset, overrides)
    options = config.game.agent.step_options(config.step_options)
    return config, options, baseline_policies(config, options, NAMES)


def test_rules_and_what_ships_have_plain_steps_on_the_games_unknowns():
    config, _, policies = found("default", "bank.intrinsics=fixed")
    assert tuple(policies) == NAMES
    assert config.step_options.intrinsics == "fixed"
    for name in set(NAMES) - {"bold"}:
        assert policies[name] == (make_policy(name), config.step_options)


@pytest.mark.parametrize("preset", ["default", "paper"])
def test_bold_has_the_guard_and_the_step_of_the_game(preset):
    config, options, policies = found(preset, "game.agent.escalate=0.75")
    assert policies["bold"] == (always(-1.0, config.game.agent), options)
    assert policies["bold"][0].config.escalate == 0.75


def test_the_rule_of_the_method_comes_first():
    assert list(found("default", "method=stba")[2]) == ["stba", *NAMES]
