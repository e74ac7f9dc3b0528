"""Whole solves: how they end, what they promise, and that every way of running them is the same
solve."""

from __future__ import annotations

from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support
from scipy.optimize import least_squares
from support import solve, start

from jaxba import (
    Ceres,
    Classic,
    Loss,
    ProblemWarning,
    Schedule,
    StepOptions,
    Termination,
    Tolerances,
    make_policy,
    random_scene_with_truth,
    scene_like,
    solve_loop,
)
from jaxba.methods.stba import StochasticClusters
from jaxba.problem import geometry
from jaxba.problem.options import Coordinates, Refinement

pytestmark = pytest.mark.step

NEVER = Tolerances(ftol=0.0, xtol=0.0, gtol=0.0)
"""No convergence test can apply."""


def stepwise(problem, policy="ceres", options=None, **settings):
    """A solve step by step: the compiled step is shared by all policies, limits and tolerances."""
    return solve(problem, policy, options, callback=lambda record: None, **settings)


# One solve, run in many ways


@pytest.mark.fully_compiled
@pytest.mark.parametrize("policy", ["ceres", "classic"])
def test_the_compiled_loop_and_the_stepwise_one_are_the_same_solve(policy):
    records = []
    compiled = solve(support.tiny(), policy)
    watched = solve(support.tiny(), policy, callback=records.append)
    assert compiled.termination == watched.termination == Termination.COST
    assert (compiled.iterations, compiled.accepted) == (watched.iterations, watched.accepted)
    costs = np.append(compiled.initial_cost, compiled.history.cost)
    assert compiled.history.accepted.all()
    # two programs round costs differently, in the last three digits; a small decrease has as many
    # fewer that are right
    wanted = {"gradient_max": 1e-6, "gain_ratio": 1e-6 + 1e-13 * costs[1:] / -np.diff(costs)}
    for name in compiled.history._fields:
        one = getattr(compiled.history, name)
        other = getattr(watched.history, name)
        assert len(one) == len(other) == compiled.iterations
        bound = wanted.get(name, 1e-8) * np.abs(other)
        assert (np.abs(one.astype(float) - other) <= bound).all(), name
    np.testing.assert_allclose(
        compiled.problem.points, watched.problem.points, rtol=1e-6, atol=1e-8
    )
    assert [r.iteration for r in records] == list(range(1, watched.iterations + 1))
    assert [r.step.cost for r in records] == list(watched.history.cost)
    times = [r.time_s for r in records]
    assert times == sorted(times)
    assert all(
        np.ndim(value) == 0 and not isinstance(value, jax.Array) for value in records[0].step
    )


@pytest.mark.slow
def test_a_batch_of_solves_equals_a_loop_of_solves():
    """Scenes end after different numbers of iterations; those that are done must rest while the
    others go on."""
    options = StepOptions()
    tolerances = Tolerances()

    def run(layout, state):
        return solve_loop(layout, state, Ceres(), tolerances, options, 30)

    pairs = [start(support.paper(seed)) for seed in range(8)]
    stacked = jax.tree.map(lambda *leaves: jnp.stack(leaves), *pairs)
    carries, histories = jax.jit(jax.vmap(run))(*stacked)
    counts = []
    for k, (layout, state) in enumerate(pairs):
        carry, history = run(layout, state)
        count = int(carry.iteration)
        counts.append(count)
        assert count == carries.iteration[k]
        assert carry.termination == carries.termination[k]
        assert np.array_equal(history.accepted, histories.accepted[k])
        np.testing.assert_allclose(histories.cost[k], history.cost, rtol=1e-8)
        np.testing.assert_allclose(carries.state.cost[k], carry.state.cost, rtol=1e-8)
        np.testing.assert_allclose(
            carries.state.points[k], carry.state.points, rtol=1e-5, atol=1e-6
        )
        assert not np.any(history.cost[count:])
    assert len(set(counts)) > 1


def test_a_policy_and_its_name_are_the_same():
    by_name = stepwise(support.tiny(), "classic:0.03")
    by_object = stepwise(support.tiny(), Classic(initial=0.03))
    assert np.array_equal(by_name.history.cost, by_object.history.cost)


@pytest.mark.xla
def test_a_second_problem_of_equal_shape_compiles_nothing():
    events = []

    def listen(event: str, seconds: float, **_: object) -> None:
        if "compile" in event:
            events.append(event)

    jax.monitoring.register_event_duration_secs_listener(listen)
    try:
        first = stepwise(support.paper(0), "ceres", max_iterations=3)
        assert events or first.compile_s < 1
        events.clear()
        second = stepwise(support.paper(1), Ceres(initial=0.7), max_iterations=3)
        assert events == []
    finally:
        jax.monitoring.unregister_event_duration_listener(listen)
    assert first.iterations == 3
    assert second.history.damping[0] == 0.7


# How a solve ends


def test_iterations_run_out():
    solution = stepwise(support.tiny(), tolerances=NEVER, max_iterations=2)
    assert solution.termination == Termination.MAX_ITERATIONS
    assert not solution.converged
    assert solution.iterations == 2


def test_the_cost_stops_falling():
    solution = stepwise(support.tiny(), tolerances=Tolerances(1e-6, 0.0, 0.0))
    costs = np.append(solution.initial_cost, solution.history.cost)
    relative = (costs[:-1] - costs[1:]) / costs[:-1]
    assert solution.termination == Termination.COST
    assert solution.converged
    assert relative[-1] <= 1e-6
    assert (relative[:-1][solution.history.accepted[:-1]] > 1e-6).all()


def test_the_step_becomes_short():
    solution = stepwise(support.tiny(), tolerances=Tolerances(0.0, 1e-4, 0.0))
    assert solution.termination == Termination.STEP
    size = np.sqrt(np.sum(solution.problem.cameras**2) + np.sum(solution.problem.points**2))
    assert solution.history.step_norm[-1] <= 1e-4 * size * (1 + 1e-3)
    assert (solution.history.step_norm[:-1] > 1e-4 * size * (1 - 1e-3)).all()


@pytest.mark.xla
def test_another_limit_compiles_nothing_and_is_kept_to():
    whole = solve(support.tiny(), "ceres")
    programs = solve_loop.__wrapped__._cache_size()
    for limit in (1, 3, 128):
        found = solve(support.tiny(), "ceres", max_iterations=limit)
        assert found.iterations == len(found.history.cost) == min(limit, whole.iterations)
        np.testing.assert_array_equal(found.history.cost, whole.history.cost[:limit])
        assert (found.termination == Termination.MAX_ITERATIONS) == (limit < whole.iterations)
    assert solve_loop.__wrapped__._cache_size() == programs


def test_the_gradient_vanishes_at_an_exact_optimum():
    """A noise-free scene started at its truth."""
    _, truth = random_scene_with_truth(replace(scene_like("tiny"), noise=0.0), 0)
    solution = stepwise(truth, tolerances=Tolerances(0.0, 0.0, 1e-6))
    assert solution.initial_cost < 1e-18
    assert solution.termination == Termination.GRADIENT
    assert solution.iterations == 1
    assert solution.history.gradient_max[0] <= 1e-6


@pytest.mark.parametrize("cluster_cameras", [2, pytest.param(100, marks=pytest.mark.slow)])
def test_a_rejected_step_is_repeated_where_clusters_take_turns(cluster_cameras):
    """With the same lambda the next clustering makes another step; a single cluster makes the same
    one for ever."""
    options = StepOptions(method=StochasticClusters(cluster_cameras=cluster_cameras))
    solution = stepwise(support.tiny(), "constant:1e30", options=options, max_iterations=5)
    assert solution.accepted == 0
    expected = (5, Termination.MAX_ITERATIONS) if cluster_cameras == 2 else (1, Termination.STALLED)
    assert (solution.iterations, solution.termination) == expected


def test_cameras_that_nobody_looks_through_make_no_step_short():
    """`xtol` is relative to the size of what is optimised."""
    problem = support.tiny()
    idle = np.array([[0, 0, 0, 1e12, 0, 0, 500, 0, 0.0]])
    more = problem.replace(cameras=np.concatenate([problem.cameras, idle]))
    plain = stepwise(problem)
    found = stepwise(more)
    np.testing.assert_allclose(found.history.cost, plain.history.cost, rtol=1e-9)
    assert found.termination == plain.termination
    np.testing.assert_array_equal(found.problem.cameras[-1], idle[0])


def test_a_noise_free_scene_is_solved_to_zero():
    problem, _ = random_scene_with_truth(replace(scene_like("tiny"), noise=0.0), 0)
    solution = stepwise(problem)
    assert solution.converged
    assert solution.final_cost < 1e-9 * solution.initial_cost


def test_a_rejected_step_never_converges_however_small_it_is():
    """Under a lambda of 1e30 nothing moves: the cost changes by nothing and the step is shorter
    than any tolerance."""
    solution = stepwise(support.tiny(), "constant:1e30")
    assert solution.history.step_norm[0] <= 1e-8
    assert (
        abs(solution.history.candidate_cost[0] - solution.initial_cost)
        <= 1e-6 * solution.initial_cost
    )
    assert solution.accepted == 0
    assert solution.termination == Termination.STALLED
    assert solution.iterations == 1
    assert not solution.converged


def test_a_policy_that_goes_on_after_rejections_is_not_stalled():
    solution = stepwise(support.tiny(), Schedule(values=(1e30, 1e29)), max_iterations=7)
    assert solution.termination == Termination.MAX_ITERATIONS
    assert (solution.iterations, solution.accepted) == (7, 0)
    assert solution.final_cost == solution.initial_cost


def test_a_repeated_lambda_is_not_a_stall_while_the_policy_has_others_to_come():
    """The paper's cycle starts with the same lambda twice."""
    solution = stepwise(support.tiny(), Schedule(values=(1e30, 1e30, 1e-4)))
    assert list(solution.history.accepted[:3]) == [False, False, True]
    assert solution.history.damping[2] == 1e-4


def test_a_lambda_at_its_upper_limit_ends_the_solve():
    solution = stepwise(support.tiny(), Classic(initial=1e31))
    assert solution.termination == Termination.DAMPING_LIMIT
    assert not solution.converged
    assert solution.iterations < 10


def test_a_lambda_that_is_no_number_ends_the_solve_where_it_began():
    solution = stepwise(support.tiny(), Schedule(values=(float("nan"), float("nan"))))
    assert solution.termination == Termination.DAMPING_LIMIT
    assert solution.iterations == 1
    assert np.array_equal(solution.problem.cameras, support.tiny().cameras)
    assert np.array_equal(solution.problem.points, support.tiny().points)


def test_a_callback_that_returns_true_stops_the_solve():
    seen = []

    def stop_after_two(record) -> bool:
        seen.append(record)
        return record.iteration == 2

    solution = solve(support.tiny(), tolerances=NEVER, callback=stop_after_two)
    assert solution.termination == Termination.STOPPED
    assert not solution.converged
    assert solution.iterations == len(seen) == 2
    assert solution.final_cost == seen[-1].step.cost
    np.testing.assert_allclose(geometry.cost(solution.problem), solution.final_cost, rtol=1e-10)


@pytest.mark.xla
@pytest.mark.parametrize("callback", [None, lambda record: None])
def test_a_solve_ends_at_the_first_cost_that_is_good_enough(callback, monkeypatch):
    """And another target compiles nothing."""
    monkeypatch.setattr("jaxba.runtime.process.release_programs", lambda: False)
    costs = stepwise(support.tiny()).history.cost
    # other programs sum in another order
    targets = (0.5 * (costs[0] + costs[1]), costs[2] * (1 + 1e-12))
    for target, iterations in zip(targets, (2, 3), strict=True):
        solution = solve(
            support.tiny(), tolerances=Tolerances(target=float(target)), callback=callback
        )
        assert solution.termination == Termination.TARGET
        assert not solution.converged
        assert solution.iterations == iterations
        assert solution.final_cost <= target
    assert solution.compile_s == 0  # of the second
    above = solve(
        support.tiny(), tolerances=Tolerances(target=0.9 * float(costs[-1])), callback=callback
    )
    assert above.termination == Termination.COST


def test_without_iterations_views_of_images_that_face_away_stay():
    problem = support.tiny()
    cameras = np.array(problem.cameras)
    turn = np.diag([-1.0, 1.0, -1.0]) @ geometry.rotation_matrices(cameras[:1, :3])[0]
    center = geometry.camera_centers(cameras)[0]
    cameras[0, :3] = geometry.angle_axis(turn[None])[0]
    cameras[0, 3:6] = -turn @ center
    turned = problem.replace(cameras=cameras)
    with pytest.warns(ProblemWarning, match="face away|faces away"):
        found = solve(turned, max_iterations=0)
    assert list(found.set_aside) == [0]
    assert found.problem.num_observations == problem.num_observations


def test_convergence_comes_before_the_wish_to_stop():
    solution = solve(support.tiny(), tolerances=Tolerances(ftol=1.0), callback=lambda record: True)
    assert solution.termination == Termination.COST


def test_every_end_has_a_reason_for_a_person():
    reasons = [end.reason for end in Termination]
    assert len(set(reasons)) == len(reasons)
    tests = {
        Termination.COST,
        Termination.STEP,
        Termination.GRADIENT,
        Termination.ROUNDING,
        Termination.WITHIN,
    }
    assert {end for end in Termination if end.converged} == tests


# What a solution promises


def check_promises(problem, solution) -> None:
    for array in (solution.problem.cameras, solution.problem.points):
        assert type(array) is np.ndarray
        assert array.dtype == np.float64
        assert np.isfinite(array).all()
    assert all(
        type(getattr(solution, name)) is float
        for name in ("initial_cost", "final_cost", "setup_s", "total_s")
    )
    history = solution.history
    assert all(type(field) is np.ndarray and len(field) == solution.iterations for field in history)
    assert solution.accepted == history.accepted.sum()
    costs = np.append(solution.initial_cost, history.cost)
    assert (np.diff(costs)[history.accepted] < 0).all()
    assert (np.diff(costs)[~history.accepted] == 0).all()
    assert costs[-1] == solution.final_cost <= solution.initial_cost
    for name in ("observations", "camera_index", "point_index"):
        assert np.array_equal(getattr(solution.problem, name), getattr(problem, name))
    assert solution.problem.cameras is not problem.cameras


@pytest.mark.parametrize("make", [support.tiny, support.odd, support.whitened, support.single])
def test_the_final_cost_is_the_cost_of_the_returned_problem(make):
    problem = make()
    before = [np.array(a) for a in support.arrays(problem)]
    solution = stepwise(problem)
    check_promises(problem, solution)
    tiny = 1e-14 * solution.initial_cost
    np.testing.assert_allclose(solution.initial_cost, geometry.cost(problem), rtol=1e-10)
    np.testing.assert_allclose(
        solution.final_cost, geometry.cost(solution.problem), rtol=1e-10, atol=tiny
    )
    assert solution.final_cost < 0.5 * solution.initial_cost
    assert all(np.array_equal(a, b) for a, b in zip(before, support.arrays(problem), strict=True))


def test_a_problem_of_jax_arrays_is_solved_like_one_of_numpy_arrays():
    of_jax = support.tiny().replace(
        cameras=jnp.asarray(support.tiny().cameras), points=jnp.asarray(support.tiny().points)
    )
    solution = stepwise(of_jax)
    check_promises(support.tiny(), solution)
    assert np.array_equal(solution.history.cost, stepwise(support.tiny()).history.cost)


@pytest.mark.parametrize(
    "name",
    ["huber", *(pytest.param(x, marks=pytest.mark.slow) for x in ("soft_l1", "cauchy", "tukey"))],
)
def test_the_final_cost_counts_the_loss(name):
    options = StepOptions(loss=Loss(name, 1.7))
    solution = stepwise(support.tiny(), options=options)
    check_promises(support.tiny(), solution)
    assert solution.converged
    np.testing.assert_allclose(
        solution.initial_cost, support.cost(support.tiny(), options), rtol=1e-10
    )
    np.testing.assert_allclose(
        solution.final_cost, support.cost(solution.problem, options), rtol=1e-10
    )


def test_a_robust_loss_finds_the_scene_behind_wrong_matches():
    """Ten observations off by 80 pixels: Cauchy's loss ends near the optimum without them, least
    squares does not."""
    clean = support.tiny()
    rng = np.random.default_rng(0)
    wrong = rng.choice(clean.num_observations, 10, replace=False)
    observations = clean.observations.copy()
    observations[wrong] += 80.0
    spoiled = clean.replace(observations=observations)
    right = np.delete(np.arange(clean.num_observations), wrong)

    def cost_of_the_right_ones(solution) -> float:
        return 0.5 * float(np.sum(geometry.residuals(solution.problem)[right] ** 2))

    best = stepwise(clean).final_cost
    robust = cost_of_the_right_ones(
        stepwise(spoiled, options=StepOptions(loss=Loss("cauchy", 1.7)))
    )
    squared = cost_of_the_right_ones(stepwise(spoiled))
    assert robust < 2 * best < squared


@pytest.mark.parametrize("policy", ["ceres", "classic", "gtsam"])
def test_what_nobody_observes_comes_back_bit_by_bit(policy):
    problem = support.odd()
    solution = stepwise(problem, policy, max_iterations=10)
    assert solution.accepted > 0
    lonely = np.setdiff1d(np.arange(problem.num_cameras), problem.camera_index)
    unseen = np.setdiff1d(np.arange(problem.num_points), problem.point_index)
    assert (len(lonely), len(unseen)) == (1, 2)
    assert solution.problem.cameras[lonely].tobytes() == problem.cameras[lonely].tobytes()
    assert solution.problem.points[unseen].tobytes() == problem.points[unseen].tobytes()
    assert (
        (solution.problem.points[problem.point_index] != problem.points[problem.point_index])
        .any(axis=1)
        .all()
    )


def test_the_minimum_is_that_of_scipy():
    """The whole problem as one dense least squares problem, from the same start."""
    problem = support.tiny()
    size = problem.cameras.size

    def unpack(x: np.ndarray):
        return problem.replace(cameras=x[:size].reshape(-1, 9), points=x[size:].reshape(-1, 3))

    best = least_squares(
        lambda x: support.linear(unpack(x), StepOptions())[0],
        np.concatenate([problem.cameras.ravel(), problem.points.ravel()]),
        jac=lambda x: support.linear(unpack(x), StepOptions())[1],
        x_scale="jac",
        ftol=1e-10,
    )
    assert best.success
    solution = stepwise(problem, tolerances=Tolerances(1e-10, 0.0, 0.0))
    np.testing.assert_allclose(solution.final_cost, best.cost, rtol=1e-6)


ENDS = {
    "implicit": StepOptions(linear_solver="implicit"),
    "manifold": StepOptions(coordinates=Coordinates(rotation="manifold")),
    "identity": StepOptions(coordinates=Coordinates(scaling="identity")),
    "refined": StepOptions(refinement=Refinement(points=3)),
}


@pytest.mark.parametrize("kind", list(ENDS))
def test_every_kind_of_step_ends_at_the_same_minimum(kind):
    best = stepwise(support.tiny(), tolerances=Tolerances(1e-10, 0.0, 0.0)).final_cost
    solution = stepwise(support.tiny(), options=ENDS[kind], tolerances=Tolerances(1e-10, 0.0, 0.0))
    check_promises(support.tiny(), solution)
    assert solution.converged
    np.testing.assert_allclose(solution.final_cost, best, rtol=1e-6)
    assert (solution.history.cg_iterations > 0).all() == (kind == "implicit")


def test_nielsens_rule_starts_in_the_units_of_the_hessian_under_identity_scaling():
    options = StepOptions(coordinates=Coordinates(scaling="identity"))
    solution = stepwise(support.tiny(), "nielsen", options, max_iterations=2)
    # rotations on the manifold, where jaxba takes the diagonal
    manifold = StepOptions(coordinates=Coordinates(scaling="identity", rotation="manifold"))
    jacobian = support.linear(support.tiny(), manifold)[1]
    np.testing.assert_allclose(
        solution.history.damping[0], 1e-5 * np.sum(jacobian**2, axis=0).max(), rtol=1e-9
    )


@pytest.mark.parametrize("solver", ["explicit", "implicit"])
def test_single_precision_ends_within_a_thousandth_of_double(solver):
    double = stepwise(support.tiny(), linear_solver=solver)
    single = stepwise(support.tiny(), linear_solver=solver, dtype="float32")
    check_promises(support.tiny(), single)
    np.testing.assert_allclose(single.final_cost, double.final_cost, rtol=1e-3)
    np.testing.assert_allclose(geometry.cost(single.problem), double.final_cost, rtol=1e-3)


def test_one_observation_is_solved_exactly():
    solution = stepwise(support.single())
    assert solution.final_cost < 1e-9
    assert np.isfinite(solution.problem.cameras).all()


# Choices and mistakes


def test_the_automatic_choice_of_the_linear_solver_is_told():
    assert (
        stepwise(support.tiny(), linear_solver="auto", max_iterations=1).linear_solver == "explicit"
    )
    assert (
        stepwise(support.tiny(), linear_solver="implicit", max_iterations=1).linear_solver
        == "implicit"
    )
    asked = StepOptions(linear_solver="implicit")
    assert stepwise(support.tiny(), options=asked, max_iterations=1).linear_solver == "implicit"


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"dtype": "float16"}, "dtype must be one of float64, float32, mixed"),
        ({"max_iterations": -1}, "max_iterations must be at least 0"),
        ({"max_iterations": 2.5}, "max_iterations must be a whole number"),
        ({"max_iterations": 2**31}, "max_iterations must be at most 2147483647"),
        ({"tolerances": Tolerances(ftol=float("nan"))}, "ftol must not be negative, is nan"),
        ({"tolerances": Tolerances(gtol=-1.0)}, "gtol must not be negative"),
        ({"policy": None}, "policy must be the name of a policy or a policy, not None"),
        ({"policy": "cerse"}, "unknown damping policy"),
        (
            {"policy": "learned", "coordinates": Coordinates(scaling="identity")},
            "lambda as a factor on the diagonal",
        ),
        ({"linear_solver": "dense"}, "linear_solver must be one of"),
        ({"method": "stba", "dtype": "mixed"}, "mixed types are for plain LM"),
    ],
)
def test_what_makes_no_sense_is_refused_in_one_line(change, message, unchecked):
    with pytest.raises(ValueError, match=message) as caught:
        solve(support.tiny(), **change)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    "name", ["ceres", "classic", "gtsam", "nielsen", "stba", "theseus", "gauss-newton"]
)
def test_every_rule_solves_a_scene_that_starts_near_its_minimum(name):
    solution = stepwise(support.tiny(), make_policy(name))
    check_promises(support.tiny(), solution)
    assert solution.converged
    assert solution.final_cost < 1.001 * stepwise(support.tiny()).final_cost
