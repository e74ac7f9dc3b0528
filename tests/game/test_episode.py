"""An episode played alone is the one that `rollout.play` plays among many."""

from __future__ import annotations

import jax
import numpy as np
import pytest
import support
from tiny_game import KIND, problem_of

from jaxba import StepOptions
from jaxba.damping import make_policy
from jaxba.game.episode import TRIES, draw, replay
from jaxba.game.random_scenes import make_scenes
from jaxba.game.rollout import play
from jaxba.game.scene_bank import MIN_OBSERVATIONS, Bank, info_of, initial_costs, select, worth_solving

LIMIT = 12


@pytest.mark.slow
def test_an_episode_is_that_of_the_bank_and_its_parameters_have_its_costs():
    scenes = make_scenes(KIND, jax.random.key(5), TRIES)
    costs = initial_costs(KIND, scenes)
    info = info_of(KIND, scenes, costs, LIMIT)
    bank = select(Bank(scenes, costs, costs, info, costs), worth_solving(KIND, info)[:3])
    policy, options = make_policy("ceres"), StepOptions()
    runs = play(KIND, bank, policy, options, LIMIT)
    for scene in range(3):
        one = replay(KIND, bank, scene, policy, options, LIMIT)
        count = int(runs.iterations[scene])
        assert len(one.damping) == count == len(one.cost) - 1
        np.testing.assert_allclose(one.cost, runs.costs[scene, : count + 1], rtol=1e-9)
        np.testing.assert_allclose(one.damping, runs.dampings[scene, :count], rtol=1e-9)
        assert one.converged == runs.converged[scene]
        assert one.problem.num_observations == problem_of(KIND, bank.scenes, scene).num_observations
        assert set(one.problem.point_index) == set(range(one.problem.num_points))
        for state in (0, count):
            problem = one.problem.replace(cameras=one.cameras[state], points=one.points[state])
            np.testing.assert_allclose(support.cost(problem, options), one.cost[state], rtol=1e-8)
    assert len(set(runs.iterations)) > 1
    with pytest.raises(IndexError, match="no scene 3 among 3"):
        replay(KIND, bank, 3, policy, options, LIMIT)


def test_scenes_are_drawn_by_number():
    policy, key = make_policy("ceres"), jax.random.key(0)
    first, again, other = (draw(KIND, key, k, policy, StepOptions(), LIMIT) for k in (3, 3, 4))
    assert (first.cost == again.cost).all()
    assert first.cost[0] != other.cost[0]
    assert first.cost[-1] < first.cost[0]
    assert first.problem.num_observations >= MIN_OBSERVATIONS
