"""The look-ahead with rollouts: what it plays is what it paid, and never more than its base policy pays."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from tiny_game import AGENT, KIND, RULES, tiny_bank

from jaxba.damping.learned import ConstantAction
from jaxba.game.env import make_game
from jaxba.game.evaluate import prices_to
from jaxba.game.look_ahead import look_ahead, play_on
from jaxba.game.rollout import play
from jaxba.game.scene_bank import draw_prices, reach
from jaxba.game.statistics import paired_ratio
from jaxba.problem.options import StepOptions

pytestmark = pytest.mark.slow

CONFIG = replace(
    AGENT, effort="points+repairs", refine_points=2, trials=1, camera_rounds=0, pattern_moves=0, lens_step="file"
)
POLICY = ConstantAction((0.0, 0.0, -1.0), CONFIG)
ACTIONS = np.array([[-0.8, -1.0, -1.0], [0.0, 0.0, -1.0], [0.6, 1.0, -1.0]])


@pytest.fixture(scope="module")
def game():
    bank = tiny_bank()
    prices = draw_prices(jax.random.key(2), len(bank.initial_cost), 1.0)
    bank = bank._replace(info=bank.info._replace(prices=prices))
    return make_game(replace(RULES, agent=CONFIG, reward="price", max_iterations=25), [KIND], [bank], [4])


@pytest.fixture(scope="module")
def alone(game):
    """The base policy's own episodes."""
    return look_ahead(game, POLICY, ACTIONS, looks=False)[0]


def test_the_base_policy_pays_what_it_pays_in_an_evaluation(game, alone):
    (bank,), rules = game.banks, game.config
    run = play(KIND, bank, POLICY, CONFIG.step_options(StepOptions()), rules.max_iterations, ftol=0.0)
    reached = reach(run.costs[:, 1:], np.asarray(bank.best_cost), rules.tolerance) + 1
    np.testing.assert_allclose(alone.paid, prices_to(run, reached, rules.max_iterations), rtol=1e-6)
    np.testing.assert_array_equal(alone.success, np.isfinite(reached))


def test_it_pays_no_more_than_its_base_and_less_somewhere(game, alone):
    (ahead,) = look_ahead(game, POLICY, ACTIONS, looks=True)
    assert (ahead.paid <= alone.paid * (1 + 1e-9)).all()
    assert (ahead.paid < 0.95 * alone.paid).any()


def test_its_first_prices_are_those_of_the_whole_episodes(game, alone):
    """The base policy's own action leads to what it pays alone."""
    (bank,) = game.banks
    prices = jax.jit(
        lambda scene: play_on(game, KIND, bank, POLICY, jnp.asarray([POLICY.action]), game.start(bank, scene))
    )
    for scene in range(3):
        np.testing.assert_allclose(prices(jnp.asarray(scene, jnp.int32))[0], alone.paid[scene], rtol=1e-9)


def test_a_paired_ratio_is_the_geometric_mean_with_the_interval_of_its_standard_error():
    rng = np.random.default_rng(0)
    theirs = rng.lognormal(size=400)
    np.testing.assert_allclose(paired_ratio(0.9 * theirs, theirs), 0.9)
    noise = rng.normal(scale=0.3, size=400)
    found = paired_ratio(theirs * np.exp(noise), theirs)
    np.testing.assert_allclose(found.mean, np.exp(noise.mean()))
    half = 1.96 * noise.std() / np.sqrt(400)
    np.testing.assert_allclose(np.log([found.low, found.high]), noise.mean() + np.array([-half, half]), atol=0.2 * half)
