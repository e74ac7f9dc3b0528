"""Warm starts of the game's scenes. Costs come from NumPy (`jaxba.geometry`)."""

from __future__ import annotations

import chex
import jax
import numpy as np
import pytest
from support import same_bits
from tiny_game import KIND, problem_of, tiny_bank

from jaxba import StepOptions
from jaxba.game.random_scenes import make_scenes
from jaxba.game.scene_bank import BankConfig, make_banks, solve_scenes
from jaxba.game.warm_starts import warm_starts
from jaxba.problem import geometry

pytestmark = pytest.mark.slow

OPTIONS = StepOptions()


def warmed(share: float, key: int = 0):
    bank = tiny_bank()
    return bank, *warm_starts(KIND, bank.scenes, bank.initial_cost, jax.random.key(key), share, OPTIONS)


def test_a_warm_start_is_the_same_scene_at_a_lower_cost():
    bank, scenes, cost = warmed(1.0)
    chex.assert_trees_all_equal(
        scenes._replace(cameras=0, points=0), bank.scenes._replace(cameras=0, points=0), strict=True
    )
    before, after = np.asarray(bank.initial_cost), np.asarray(cost)
    assert (after <= before).all()
    assert (after < before).mean() > 0.5
    for k in range(len(after)):
        np.testing.assert_allclose(after[k], geometry.cost(problem_of(KIND, scenes, k)), rtol=1e-9)


def test_the_share_says_how_many_scenes_move():
    bank, scenes, cost = warmed(0.0)
    chex.assert_trees_all_equal((scenes, cost), (bank.scenes, bank.initial_cost), strict=True)
    moved = np.mean([np.asarray(warmed(0.3, key)[2]) != np.asarray(bank.initial_cost) for key in range(3)])
    all_moved = np.mean([np.asarray(warmed(1.0, key)[2]) != np.asarray(bank.initial_cost) for key in range(3)])
    assert moved == pytest.approx(0.3 * all_moved, abs=0.1)


def test_the_same_key_gives_the_same_warm_starts_and_another_one_others():
    first, again, other = (warmed(1.0, key)[1:] for key in (1, 1, 2))
    chex.assert_trees_all_equal(first, again, strict=True)
    assert not same_bits(first, other)


def test_a_bank_with_warm_starts_begins_nearer_the_best_cost_and_says_so_to_the_policy():
    key = jax.random.key(5)
    scenes = make_scenes(KIND, key, 120)
    solved = lambda share: solve_scenes(KIND, key, scenes, OPTIONS, 40, rules=("ceres",), warm_share=share)
    cold, warm = solved(0.0)[0], solved(1.0)[0]
    ratio = lambda bank: np.median(np.asarray(bank.initial_cost / bank.best_cost))
    assert ratio(warm) < 0.1 * ratio(cold)
    chex.assert_trees_all_equal(warm.info.cost, warm.initial_cost, strict=True)


@pytest.mark.parametrize("share", [-0.5, 1.5])
def test_a_share_that_is_none_is_refused(share):
    with pytest.raises(ValueError, match=f"warm_share must be 0 to 1, is {share}"):
        BankConfig(warm_share=share)


def test_the_share_of_the_settings_reaches_the_bank(monkeypatch):
    monkeypatch.setattr("jaxba.game.scene_bank.PORTFOLIO", ("ceres",))
    banks = [BankConfig((KIND,), (60,), 0, share) for share in (0.0, 1.0)]
    made = [make_banks(bank, jax.random.key(0), OPTIONS, 40)[0].train for bank in banks]
    cold, warm = (np.median(np.asarray(bank.initial_cost / bank.best_cost)) for bank in made)
    assert warm < 0.1 * cold
