"""Policies that decide with lambda what an iteration may cost: point iterations and the forcing term."""

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
from jaxba.damping.guard import FORCING, effort_for
from jaxba.damping.learned import ConstantAction, Layer, LearnedPolicy
from jaxba.damping.policy_file import PolicyFileError, load_policy, save_policy
from jaxba.game import constant_actions
from jaxba.game.env import CG_ITERATION_COST, POINT_ITERATION_COST, make_game
from jaxba.game.rollout import play
from jaxba.game.scene_bank import draw_prices
from jaxba.io.settings import SettingsError
from jaxba.linear.step import Effort
from jaxba.lm.records import Prices
from jaxba.methods.deeplm import GlobalConjugateGradients
from jaxba.problem.options import ConjugateGradients, Refinement
from jaxba.training import config as configs

POINTS = replace(AGENT, effort="points", refine_points=3)
BOTH = replace(POINTS, effort="points+forcing")
PAID = replace(POINTS, effort="points+repairs")
ALL = Refinement(points=1, trials=4, camera_rounds=3, pattern_moves=2)

_step = jax.jit(lm_step, static_argnames=("options",))
_jitted_reset = jax.jit(lambda game, key: game.reset(key))
_jitted_play = jax.jit(lambda game, state, action: game.step(state, action))
_effort_for = jax.jit(effort_for, static_argnums=0)


def effort(points: int, forcing: float | None = None) -> Effort:
    return Effort(jnp.asarray(points, jnp.int32), None if forcing is None else jnp.asarray(forcing))


# The step


def test_a_step_with_fewer_point_iterations_is_that_of_options_with_fewer_and_compiles_nothing():
    options = StepOptions(refinement=Refinement(points=3))
    layout, state = start(tiny(), options)
    damping = jnp.asarray(1e-3)
    costs = []
    for count in (1, 3):
        expected, _ = step(layout, state, 1e-3, replace(options, refinement=replace(options.refinement, points=count)))
        found, _ = _step(layout, state, damping, options, effort=effort(count))
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-12)
        np.testing.assert_allclose(found.points, expected.points, rtol=1e-9, atol=1e-12)
        costs.append(float(found.cost))
    assert costs[1] < costs[0]
    compiled = _step._cache_size()
    none, _ = _step(layout, state, damping, options, effort=effort(0))
    more, _ = _step(layout, state, damping, options, effort=effort(9))
    np.testing.assert_allclose(more.cost, costs[1], rtol=1e-12)  # never more than the options have
    assert _step._cache_size() == compiled
    plain, _ = step(layout, state, 1e-3, StepOptions())
    np.testing.assert_allclose(none.cost, plain.cost, rtol=1e-12)
    assert none.cost > costs[0]


def implicit(forcing: float) -> StepOptions:
    rule = ConjugateGradients(forcing=forcing)
    return StepOptions(linear_solver="implicit", refinement=Refinement(points=1), conjugate_gradients=rule)


def deeplm(forcing: float) -> StepOptions:
    method = GlobalConjugateGradients(ConjugateGradients(forcing=forcing))
    return StepOptions(method=method, refinement=Refinement(points=1))


@pytest.mark.slow
@pytest.mark.parametrize("options", [deeplm])
def test_a_step_with_another_forcing_term_is_that_of_options_with_it(options):
    own = 1e-3
    layout, state = start(tiny(), options(own))
    iterations = []
    for forcing, chosen in ((0.5, effort(1, 0.5)), (1e-6, effort(1, 1e-6)), (own, effort(1))):
        expected, one = step(layout, state, 1e-6, options(forcing))
        found, other = _step(layout, state, jnp.asarray(1e-6), options(own), effort=chosen)
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-12)
        assert int(one.cg_iterations) == int(other.cg_iterations)
        np.testing.assert_allclose([one.forcing, other.forcing], forcing)
        iterations.append(int(other.cg_iterations))
    assert iterations[0] < iterations[2] < iterations[1]


def test_a_step_without_repairs_is_that_of_options_without_them_and_counts_its_work():
    layout, state = start(tiny(), StepOptions(refinement=ALL))
    costs, repairs = [], []
    for damping in (1e-8, 1e-4, 1e2):  # refused, mended, and too short
        run = lambda allowed, damping=damping: _step(
            layout,
            state,
            jnp.asarray(damping),
            StepOptions(refinement=ALL),
            effort=effort(1)._replace(repairs=jnp.asarray(allowed)),
        )
        (found, few), (_, many) = run(False), run(True)
        expected, plain = step(layout, state, damping, StepOptions(refinement=Refinement(points=1)))
        np.testing.assert_allclose(found.cost, expected.cost, rtol=1e-12)
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


def _chosen(config: AgentConfig, memory, *action: float) -> tuple[int, float | None]:
    found = _effort_for(config, memory.guard, jnp.asarray(action, jnp.float32))
    return int(found.point_iterations), None if found.forcing is None else float(jnp.log10(found.forcing))


def test_an_action_ranges_from_no_point_iteration_to_all_and_over_the_forcing_terms():
    assert (AGENT.action_size, POINTS.action_size, BOTH.action_size) == (1, 2, 3)
    memory = begin(BOTH, info())
    found = [_chosen(BOTH, memory, 0.3, share, share) for share in (-1, -0.4, 0.4, 1)]
    assert [points for points, _ in found] == [0, 1, 2, 3]
    np.testing.assert_allclose([forcing for _, forcing in found], np.interp([-1, -0.4, 0.4, 1], [-1, 1], FORCING))
    assert _chosen(POINTS, begin(POINTS, info()), 0.3, -1) == (0, None)
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
    config = replace(BOTH, patience=2)
    memory = begin(config, info())
    for accepted in (REJECTED, REJECTED, ACCEPTED):
        memory = after(config, memory, accepted, -3.0)
        np.testing.assert_allclose(_chosen(config, memory, -1, -1, 1), (0, FORCING[1]))
    assert memory.guard.handed_over


def test_the_effort_of_the_last_step_is_observed():
    for config in (POINTS, BOTH):
        memory = begin(config, info())
        seen = []
        for share in (-1.0, 1.0):
            chosen = effort_for(config, memory.guard, jnp.full(config.action_size, share, jnp.float32))
            seen.append(np.asarray(observe(config, after(config, memory._replace(effort=chosen), ACCEPTED, -3.0))))
            assert seen[-1].shape == (observation_size(config),)
        assert observation_size(config) == observation_size(AGENT) + config.action_size - 1
        different = np.flatnonzero(seen[0] != seen[1])
        np.testing.assert_array_equal(different, np.arange(observation_size(AGENT), observation_size(config)))


# Policies


@pytest.mark.slow
def test_a_policy_that_always_wants_one_point_iteration_solves_as_a_rule_with_one_does(tmp_path):
    """In both loops of a solve, and after it was written to a file and read."""
    config = replace(POINTS, guard="off")
    zero = [Layer(0 * layer.kernel, 0 * layer.bias) for layer in random_policy(4, config).layers]
    bias = np.arctanh([1 / 6, -0.4]).astype(np.float32)  # a lambda of 1e-3, and one of three
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
    policy = random_policy(4, POINTS)
    last = policy.layers[-1]
    short = (*policy.layers[:-1], last._replace(kernel=last.kernel[:, :2], bias=last.bias[:2]))
    save_policy(path, replace(policy, layers=short))
    with pytest.raises(PolicyFileError, match="must give 4 numbers, not 2"):
        load_policy(path)


# The game


@pytest.mark.slow
def test_an_iteration_is_paid_by_the_point_iterations_that_the_action_chose():
    game = tiny_game(replace(RULES, agent=replace(POINTS, guard="off")), 6)
    assert game.action_size == 2
    state, seen = _jitted_reset(game, jax.random.key(0))
    assert seen.shape == (6, game.observation_size)
    share = jnp.asarray([-1, -0.4, 0.4, 1, -1, 1], jnp.float32)
    action = jnp.stack([jnp.full(6, 0.9, jnp.float32), share], axis=1)  # a lambda that reaches no goal
    _, found = _jitted_play(game, state, action)
    price = -RULES.scale * (1 + POINT_ITERATION_COST * np.array([0, 1, 2, 3, 0, 3]))
    np.testing.assert_allclose(found.reward - RULES.scale * RULES.bonus * found.metrics["success"], price, rtol=1e-5)
    assert game.demonstrate(state, jax.random.key(1)).shape == (6, 2)


@pytest.mark.slow
def test_an_iteration_is_paid_by_its_conjugate_gradients_where_the_action_chooses_the_forcing_term():
    config = replace(RULES, agent=replace(BOTH, guard="off", refine_points=1))
    game = make_game(config, [KIND], [tiny_bank()], [4], StepOptions(method=GlobalConjugateGradients()))
    state, _ = _jitted_reset(game, jax.random.key(0))
    paid = []
    for forcing in (-1.0, 1.0):
        action = jnp.broadcast_to(jnp.asarray([0.9, 1.0, forcing], jnp.float32), (4, 3))
        _, found = _jitted_play(game, state, action)
        net = found.reward - RULES.scale * RULES.bonus * found.metrics["success"]
        iterations = (-net / RULES.scale - 1 - POINT_ITERATION_COST) / CG_ITERATION_COST
        np.testing.assert_allclose(iterations, np.round(iterations), atol=1e-3)
        paid.append(np.asarray(iterations))
    assert (paid[0] > paid[1] + 0.5).all()
    assert (paid[1] > 0.5).all()


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
        (("game.agent.effort=all",), "effort must be one of fixed, points"),
        (("game.agent={effort: points, refine_points: 0}",), "needs embedded point iterations"),
        (("game.agent.effort=points", "method=ddlm"), "has no effect on method ddlm"),
        (("game.agent.effort=points+forcing",), "needs conjugate gradients"),
    ],
)
def test_an_effort_that_cannot_be_chosen_is_refused_in_one_line(changes, message):
    with pytest.raises(SettingsError, match=message) as found:
        configs.load("default", changes)
    assert "\n" not in str(found.value)


def test_an_effort_that_the_method_has_is_taken():
    chosen = configs.load("default", ("game.agent.effort=points+forcing", "method=deeplm"))
    assert chosen.game.agent.action_size == 3
