"""The look-ahead with rollouts: never more iterations than its base policy takes."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_game import AGENT, KIND, RULES, tiny_bank

from benchmarks.foresight import look_ahead, play_on
from jaxba.damping.learned import always
from jaxba.game.env import make_game
from jaxba.game.rollout import play
from jaxba.game.scene_bank import reach
from jaxba.problem.options import StepOptions

pytestmark = pytest.mark.slow

CONFIG = replace(AGENT, lens_step="file")
POLICY = always(0.0, CONFIG)
ACTIONS = np.array([[-0.8], [0.0], [0.6]])


@pytest.fixture(scope="module")
def game():
    return make_game(replace(RULES, agent=CONFIG, max_iterations=25), KIND, tiny_bank(), 4)


@pytest.fixture(scope="module")
def alone(game):
    """Iterations and success of the base policy's own episodes."""
    return look_ahead(game, POLICY, ACTIONS, looks=False)


def test_the_base_policy_takes_the_iterations_that_it_takes_in_an_evaluation(game, alone):
    bank = game.bank
    rules = game.config
    run = play(
        KIND, bank, POLICY, CONFIG.step_options(StepOptions()), rules.max_iterations, ftol=0.0
    )
    reached = reach(run.costs[:, 1:], np.asarray(bank.best_cost), rules.tolerance) + 1
    np.testing.assert_array_equal(alone[0], np.minimum(reached, rules.max_iterations))
    np.testing.assert_array_equal(alone[1], np.isfinite(reached))


def test_it_takes_no_more_than_its_base_and_fewer_somewhere(game, alone):
    iterations, success = look_ahead(game, POLICY, ACTIONS, looks=True)
    assert (iterations <= alone[0]).all()
    assert (iterations < alone[0]).any()
    assert (success >= alone[1]).all()


def test_its_first_numbers_are_those_of_the_whole_episodes(game, alone):
    """The base policy's own action leads to what it takes alone."""
    bank = game.bank
    found = jax.jit(
        lambda scene: play_on(game, bank, POLICY, jnp.zeros((1, 1)), game.start(bank, scene))
    )
    for scene in range(3):
        assert found(jnp.asarray(scene, jnp.int32))[0] == alone[0][scene]
