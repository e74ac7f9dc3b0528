"""Agents of the reproduction run: their settings, the scenes that are kept for the tables, and
fixed lenses."""

from __future__ import annotations

import jax
import numpy as np
import pytest
from support import paper, solve

from jaxba import StepOptions, settings
from jaxba.game.random_scenes import SceneClass
from jaxba.game.scene_bank import (
    EASY_ENOUGH,
    MAX_RATIO,
    MIN_RATIO,
    BankConfig,
    Split,
    held_out_count,
    make_split,
)
from jaxba.paper import agents, config
from jaxba.paper.config import AgentsConfig, PaperConfig
from jaxba.paper.tables_and_figures.figures import small_scene
from jaxba.training.config import load

CONFIG = config.load("fast")


@pytest.mark.parametrize(
    ("agent", "changed"),
    [
        (agents.with_state_size(5), []),
        (agents.with_state_size(20), ["game.agent.history"]),
        (agents.REDUCTION, ["game.reward"]),
        (agents.CLOCK, ["game.bonus", "game.reward", "game.scale"]),
        (agents.REVERSED, ["game.agent.observation", "game.reward"]),
        (agents.FEW, []),
    ],
)
def test_agents_differ_only_in_the_settings_that_their_table_compares(agent, changed):
    ours, theirs = (agents.train_config(CONFIG, one) for one in (agents.OURS, agent))
    assert sorted(settings.differences(ours, theirs)) == changed


def test_all_kinds_of_agents_are_trained_on_the_same_scenes_side_by_side():
    printed, ours, best = (
        agents.train_config(CONFIG, one) for one in (agents.PRINTED, agents.OURS, agents.BEST)
    )
    assert printed.bank == ours.bank == best.bank
    assert printed.seeds == ours.seeds == best.seeds == CONFIG.agents.seeds
    whole = load(agents.BEST.preset)
    assert best.chunks == round(CONFIG.agents.length * whole.chunks)
    assert best.game == whole.game


def test_ours_is_the_papers_agent():
    found = agents.train_config(CONFIG, agents.PRINTED)
    assert (found.game.agent.observation, found.game.agent.history, found.game.reward) == (
        "paper",
        5,
        "constant",
    )
    assert (found.game.bonus, found.loop.warmup_steps, found.sac.variant, found.sac.width) == (
        10.0,
        500,
        "value",
        256,
    )
    # and a linear one: three and four fully connected
    assert (found.sac.layers, found.sac.policy_layers) == (2, 3)
    assert found.bank.kind == SceneClass(10, 10, "paper")
    assert found.bank.intrinsics == "fixed"
    assert found.game.max_iterations == 100


@pytest.fixture(scope="module")
def split() -> Split:
    kind = SceneClass(4, 12, "paper")
    made = BankConfig(kind=kind, scenes=60, refine_points=0, intrinsics="fixed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxba.game.scene_bank.PORTFOLIO", ("ceres",))
        return make_split(made, jax.random.key(0), made.options, 40)


@pytest.mark.slow
def test_held_out_scenes_are_not_training_scenes(split):
    train, held_out = (set(map(bytes, np.asarray(bank.scenes.pixels))) for bank in split)
    assert len(train) == len(split.train.initial_cost)
    assert (
        len(held_out)
        == len(split.held_out.initial_cost)
        == held_out_count(len(train) + len(held_out))
    )
    assert not train & held_out


@pytest.mark.parametrize(
    ("usable", "held"), [(1, 1), (60, 20), (600, 200), (900, 200), (4572, 457)]
)
def test_a_tenth_is_held_out_or_two_hundred_scenes_but_no_more_than_a_third(usable, held):
    assert held_out_count(usable) == held


@pytest.mark.slow
def test_scenes_are_neither_solved_at_the_start_nor_unsolvable(split):
    for bank in split:
        ratio = np.asarray(bank.initial_cost) / np.asarray(bank.best_cost)
        assert (ratio > MIN_RATIO).all()
        assert (ratio < MAX_RATIO).all()
        # the portfolio has only this rule
        assert (np.asarray(bank.ceres_iterations) <= EASY_ENOUGH).all()


@pytest.mark.slow
def test_the_scenes_of_the_tables_are_not_used_in_training(split, monkeypatch, tmp_path):
    monkeypatch.setattr(agents, "_shared_scenes", lambda *_: split)
    train_on, test = agents.scenes(CONFIG, tmp_path, lambda _: None)
    costs = [
        set(np.asarray(bank.initial_cost).tolist()) for bank in (train_on, test, split.held_out)
    ]
    assert len(costs[1]) == len(costs[2]) == len(split.held_out.initial_cost)
    assert not costs[0] & costs[1]
    assert not costs[1] & costs[2]
    assert costs[0] | costs[1] == set(np.asarray(split.train.initial_cost).tolist())


@pytest.mark.slow
def test_the_agent_with_few_scenes_trains_on_the_first_ones(split):
    few = PaperConfig(agents=AgentsConfig(trajectories=3))
    wanted = agents.train_config(few, agents.FEW)
    game = agents.game(few, agents.FEW, wanted, split.train)
    np.testing.assert_array_equal(game.bank.initial_cost, split.train.initial_cost[:3])
    assert game.options == StepOptions(intrinsics="fixed")
    whole = agents.game(few, agents.OURS, wanted, split.train)
    assert len(whole.bank.initial_cost) == len(split.train.initial_cost)


def test_a_fixed_lens_is_bitwise_unchanged_and_poses_change():
    problem = paper(0)
    found = solve(problem, "ceres", StepOptions(intrinsics="fixed"), max_iterations=10).problem
    assert found.cameras[:, 6:].tobytes() == np.asarray(problem.cameras[:, 6:]).tobytes()
    assert (np.asarray(found.cameras[:, :6]) != problem.cameras[:, :6]).all()


def test_a_small_scene_is_determined_if_the_lens_is_known():
    problem = small_scene(5, 3).read()
    assert (problem.num_cameras, problem.num_points, problem.num_observations) == (5, 5, 25)
    assert 2 * problem.num_observations > 6 * 5 + 3 * 5 - 7
    assert 2 * problem.num_observations < 9 * 5 + 3 * 5 - 7
    truth = solve(problem, "ceres", StepOptions(intrinsics="fixed"))
    assert truth.converged
    # half a pixel of noise on each of 50 residuals, of which 38 unknowns fit a part
    assert truth.final_cost < 0.5 * 0.25 * 50
