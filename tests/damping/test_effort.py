"""Policies that decide with lambda what an iteration may cost: point iterations and repairs."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from agent_steps import ACCEPTED, REJECTED, after, info
from support import solve, start, step, step_info, tiny
from test_learned import random_policy
from tiny_game import AGENT, KIND, RULES, tiny_bank, tiny_game

from jaxba import Schedule, StepOptions, lm_step
from jaxba.damping.agent_config import AgentConfig
from jaxba.damping.features import begin, observation_size, observe
from jaxba.damping.guard import effort_for
from jaxba.damping.learned import ConstantAction, Layer, LearnedPolicy
from jaxba.damping.policy_file import PolicyFileError, load_policy, save_policy
from jaxba.game import constant_actions
from jaxba.game.env import POINT_ITERATION_COST, make_game
from jaxba.game.rollout import play
from jaxba.game.scene_bank import draw_prices
from jaxba.linear.step import Effort
from jaxba.lm.records import Prices
from jaxba.problem.options import Refinement
from jaxba.settings import SettingsError
from jaxba.training import config as configs

PAID = replace(AGENT, effort="points+repairs", refine_points=3)
ALL = Refinement(points=1, trials=4, camera_rounds=3, pattern_moves=2)

_step = jax.jit(lm_step, static_argnames=("options",))
_jitted_reset = jax.jit(lambda game, key: game.reset(key))
_jitted_play = jax.jit(lambda game, state, action: game.step(state, action))
_effort_for = jax.jit(effort_for, static_argnums=0)


def effort(points: int, repairs: bool = True) -> Effort:
    return Effort(jnp.asarray(points, jnp.int32), jnp.asarray(repairs))


# The step


def test_a_step_with_fewer_point_iterations_is_that_of_options_with_fewer_and_compiles_nothing():
    options = StepOptions(refinement=Refinement(points=3))
    layout, state = start(tiny(), options)
    damping = jnp.asarray(1e-3)
    costs = []
    for count in (1, 3):
        expected, _ = step(layout, state, 1e-3, replace(options, refinement=replace(options.refinement, points=count)))
        found, _ = _step(layout, state, damping, options, effort=effort(count))
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-9)
        np.testing.assert_allclose(found.points, expected.points, rtol=1e-9, atol=1e-12)
        costs.append(float(found.cost))
    assert costs[1] < costs[0]
    compiled = _step._cache_size()
    none, _ = _step(layout, state, damping, options, effort=effort(0))
    more, _ = _step(layout, state, damping, options, effort=effort(9))
    np.testing.assert_allclose(more.cost, costs[1], rtol=1e-9)  # never more than the options have
    assert _step._cache_size() == compiled
    plain, _ = step(layout, state, 1e-3, StepOptions())
    np.testing.assert_allclose(none.cost, plain.cost, rtol=1e-9)
    assert none.cost > costs[0]


def test_a_step_without_repairs_is_that_of_options_without_them_and_counts_its_work():
    layout, state = start(tiny(), StepOptions(refinement=ALL))
    costs, repairs = [], []
    for damping in (1e-8, 1e-4, 1e2):  # refused, mended, and too short
        run = lambda allowed, damping=damping: _step(
            layout,
            state,
            jnp.asarray(damping),
            StepOptions(refinement=ALL),
            effort=effort(1, allowed),
        )
        (found, few), (_, many) = run(False), run(True)
        expected, plain = step(layout, state, damping, StepOptions(refinement=Refinement(points=1)))
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-9)
        assert (few.repairs, few.camera_rounds, few.point_iterations) == (0, 0, 1)
        assert bool(few.accepted) == bool(plain.accepted)
        assert many.camera_rounds <= many.repairs
        assert many.point_iterations == 1 + many.repairs  # one for every candidate
        costs.append(float(many.cost) - float(few.cost))
        repairs.append(int(many.repairs))
    assert min(costs) < 0
    assert max(repairs) > 1


def test_an_iteration_costs_its_work_times_the_prices():
    record = after_step(repairs=3, camera_rounds=2, point_iterations=4, cg_iterations=5)
    np.testing.assert_allclose(Prices(0.1, 0.01, 0.2, 0.5).of(record), 1 + 0.3 + 0.04 + 0.4 + 2.5)
    assert float(Prices().of(after_step())) == 1


def after_step(**work: int):
    return step_info(accepted=True)._replace(**{name: jnp.asarray(count) for name, count in work.items()})


# The agent


def _chosen(config: AgentConfig, memory, *action: float) -> tuple[int, bool]:
    found = _effort_for(config, memory.guard, jnp.asarray(action, jnp.float32))
    return int(found.point_iterations), bool(found.repairs)


def test_an_action_ranges_from_no_point_iteration_to_all():
    assert (AGENT.action_size, PAID.action_size) == (1, 3)
    memory = begin(PAID, info())
    assert [_chosen(PAID, memory, 0.3, share, -1)[0] for share in (-1, -0.4, 0.4, 1)] == [0, 1, 2, 3]
    assert effort_for(AGENT, begin(AGENT, info()).guard, jnp.zeros(1)) is None


def test_repairs_are_allowed_by_a_positive_number():
    guard = begin(PAID, info()).guard
    allowed = lambda share, guard=guard: bool(_effort_for(PAID, guard, jnp.asarray([0, 0, share], jnp.float32)).repairs)
    assert [allowed(share) for share in (-1.0, -0.01, 0.01, 1.0)] == [False, False, True, True]


def test_prices_are_observed_where_work_is_paid():
    at = lambda factor: info()._replace(prices=Prices(*(jnp.asarray(factor * x) for x in Prices())))
    observed = [np.asarray(observe(PAID, begin(PAID, at(factor)))) for factor in (1.0, 10.0)]
    assert observed[0].shape == (observation_size(PAID),)
    np.testing.assert_allclose((observed[1] - observed[0])[-len(Prices._fields) :], 1, atol=1e-5)
    np.testing.assert_array_equal(observed[0][: -len(Prices._fields)], observed[1][: -len(Prices._fields)])


def test_the_effort_stays_the_agents_where_the_guards_rule_chooses_lambda():
    config = replace(PAID, patience=2)
    memory = begin(config, info())
    for accepted in (REJECTED, REJECTED, ACCEPTED):
        memory = after(config, memory, accepted, -3.0)
        assert _chosen(config, memory, -1, -1, 1) == (0, True)
    assert memory.guard.handed_over


def test_the_effort_of_the_last_step_is_observed():
    memory, seen = begin(PAID, info()), []
    for share in (-1.0, 1.0):
        chosen = effort_for(PAID, memory.guard, jnp.full(3, share, jnp.float32))
        seen.append(np.asarray(observe(PAID, after(PAID, memory._replace(effort=chosen), ACCEPTED, -3.0))))
        assert seen[-1].shape == (observation_size(PAID),)
    assert observation_size(PAID) == observation_size(AGENT) + 2 + len(Prices._fields)
    np.testing.assert_array_equal(np.flatnonzero(seen[0] != seen[1]), observation_size(AGENT) + np.arange(2))


# Policies


@pytest.mark.slow
def test_a_policy_that_always_wants_one_point_iteration_solves_as_a_rule_with_one_does(tmp_path):
    """In both loops of a solve, and after it was written to a file and read."""
    config = replace(PAID, guard="off")
    zero = [Layer(0 * layer.kernel, 0 * layer.bias) for layer in random_policy(4, config).layers]
    bias = np.arctanh([1 / 6, -0.4, 0.5]).astype(np.float32)  # a lambda of 1e-3, one of three, and repairs
    zero[-1] = zero[-1]._replace(bias=np.concatenate([bias, bias]))
    path = tmp_path / "two.safetensors"
    save_policy(path, LearnedPolicy(tuple(zero), config))
    options = config.step_options(StepOptions())
    rule = Schedule(values=(1e-3,), min_gain=config.min_gain)
    expected = solve(
        tiny(), rule, replace(options, refinement=replace(options.refinement, points=1)), max_iterations=8
    ).history
    for callback in (None, lambda _: None):
        found = solve(tiny(), load_policy(path), options, max_iterations=8, callback=callback).history
        np.testing.assert_allclose(found.damping, 1e-3, rtol=1e-5)
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-5)


def test_a_file_with_too_few_numbers_for_its_effort_is_refused(tmp_path):
    path = tmp_path / "wrong.safetensors"
    policy = random_policy(4, PAID)
    last = policy.layers[-1]
    short = (*policy.layers[:-1], last._replace(kernel=last.kernel[:, :2], bias=last.bias[:2]))
    save_policy(path, replace(policy, layers=short))
    with pytest.raises(PolicyFileError, match="must give 6 numbers, not 2"):
        load_policy(path)


# The game


@pytest.mark.slow
def test_an_iteration_is_paid_by_the_point_iterations_that_the_action_chose():
    game = tiny_game(replace(RULES, agent=replace(PAID, guard="off", trials=1, camera_rounds=0, pattern_moves=0)), 6)
    assert game.action_size == 3
    state, seen = _jitted_reset(game, jax.random.key(0))
    assert seen.shape == (6, game.observation_size)
    share = jnp.asarray([-1, -0.4, 0.4, 1, -1, 1], jnp.float32)
    action = jnp.stack([jnp.full(6, 0.9, jnp.float32), share, share], axis=1)  # a lambda that reaches no goal
    _, found = _jitted_play(game, state, action)
    price = -RULES.scale * (1 + POINT_ITERATION_COST * np.array([0, 1, 2, 3, 0, 3]))
    np.testing.assert_allclose(found.reward - RULES.scale * RULES.bonus * found.metrics["success"], price, rtol=1e-5)
    assert game.demonstrate(state, jax.random.key(1)).shape == (6, 3)


@pytest.mark.slow
def test_work_is_paid_at_the_prices_of_the_scene():
    """In the game, and in an evaluation: a lambda that reaches no goal, with no, one and three point iterations."""
    agent = replace(PAID, guard="off", trials=1, camera_rounds=0, pattern_moves=0)
    bank = tiny_bank()
    prices = draw_prices(jax.random.key(1), len(bank.initial_cost), 1.0)
    assert len({*np.asarray(prices.point_iteration).tolist()}) == len(bank.initial_cost)
    decades = np.log10(np.asarray(prices.camera_round) / Prices().camera_round)
    assert np.abs(decades).max() <= 0.5
    bank = bank._replace(info=bank.info._replace(prices=prices))
    game = make_game(replace(RULES, agent=agent, reward="price"), [KIND], [bank], [4])
    state, _ = _jitted_reset(game, jax.random.key(0))
    for count, share in ((0, -1.0), (1, -0.4), (3, 1.0)):
        action = jnp.broadcast_to(jnp.asarray([0.9, share, -1.0], jnp.float32), (4, 3))
        _, found = _jitted_play(game, state, action)
        net = found.reward - RULES.scale * RULES.bonus * found.metrics["success"]
        scene = np.asarray(state.episodes[0].scene)
        own, usual = np.asarray(prices.point_iteration)[scene], np.asarray(bank.ceres_iterations)[scene]
        relative = 8 / np.clip(usual, 1, RULES.max_iterations)  # to the difficulty of the scene
        np.testing.assert_allclose(-net / RULES.scale, relative * (1 + count * own), rtol=1e-5)
    policy = ConstantAction((0.9, -0.4, -1.0), agent)
    run = play(KIND, bank, policy, agent.step_options(StepOptions()), 3)
    rate = 1 + np.asarray(prices.point_iteration)
    expected = rate[:, None] * np.minimum(np.arange(4), run.iterations[:, None])
    np.testing.assert_allclose(run.paid, expected, rtol=1e-6)


def test_the_best_constant_action_is_searched_one_number_after_the_other(monkeypatch):
    best = (constant_actions.LAMBDAS[3], -1 / 3, -1.0)
    cost = lambda kinds, banks, policy, *_: SimpleNamespace(
        price=sum((a - b) ** 2 for a, b in zip(policy.action, best, strict=True))
    )
    monkeypatch.setattr(constant_actions, "evaluate", cost)
    found = constant_actions.best_constant_action([KIND], [tiny_bank()], PAID, StepOptions())
    np.testing.assert_allclose(found.action, best)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (("game.agent.effort=all",), r"effort must be one of fixed, points\+repairs"),
        (("game.agent={effort: points+repairs, refine_points: 0}",), "needs embedded point iterations"),
    ],
)
def test_an_effort_that_cannot_be_chosen_is_refused_in_one_line(changes, message):
    with pytest.raises(SettingsError, match=message) as found:
        configs.load("default", changes)
    assert "\n" not in str(found.value)
