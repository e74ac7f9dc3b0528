"""A solve on several devices is that on one: every observation is on one device, and costs agree to
rounding."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from collections import Counter

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import support

import jaxba
from jaxba import (
    BundleProblem,
    Lenses,
    ProblemError,
    SolveOptions,
    hold,
    random_scene,
    solve,
    with_position_priors,
)
from jaxba.lm.termination import Tolerances
from jaxba.problem import geometry
from jaxba.problem.options import StepOptions
from jaxba.solver import sharded
from jaxba.solver.prepare import set_up
from jaxba.solver.sharded import _run, deal_points, sharded_layout, shards_of

DEVICES = 3
"""Of the tests (conftest.py): a number that divides little."""


def sequence() -> BundleProblem:
    """Cameras in a row, of which neighbours see the same points."""
    return random_scene(jaxba.SceneConfig(cameras=20, points=150), 0)


def general() -> BundleProblem:
    """Shared and partly constant lenses, constant poses and points, priors, covariances."""
    problem = support.tiny()
    cameras = np.array(problem.cameras)
    lens = np.array([0, 0, 1, 1, 2, 0], np.int32)
    cameras[:, 6:] = cameras[lens, 6:]
    free = np.array([[True, True, True], [True, False, True], [False, False, False]])
    spread = np.tile(np.diag([0.5, 2.0]), (problem.num_observations, 1, 1))
    parts = (cameras, *support.arrays(problem)[1:])
    found = BundleProblem.create(*parts, covariance=spread, lenses=Lenses(lens, free))
    found = with_position_priors(
        found, geometry.camera_centers(cameras) + 0.01, 0.01 * np.eye(3), align=False
    )
    return hold(found, poses=[2], points=[3, 17])


def compare(problem: BundleProblem, policy: str, rtol: float = 1e-10, **options) -> jaxba.Solution:
    one, several = (
        solve(
            problem, policy, SolveOptions(max_iterations=6, pad=False, devices=devices, **options)
        )
        for devices in (None, DEVICES)
    )
    shared = min(len(one.history.cost), len(several.history.cost))
    assert shared >= 3
    np.testing.assert_allclose(several.history.cost[:shared], one.history.cost[:shared], rtol=rtol)
    if not problem.residuals:
        np.testing.assert_allclose(
            geometry.cost(several.problem), several.final_cost, rtol=max(rtol, 1e-9)
        )
    return several


@jaxba.residual
def depth(pose, point, image, *, measured):
    return image[0] * pose.to_camera(point)[2] - measured


@jaxba.residual
def apart(pose, pose_2, size, *, measured):
    return 10 * (pose.center - pose_2.center - size[0] * measured)


@jaxba.residual
def bar(point, point_2, *, length):
    return jnp.linalg.norm(point - point_2) * 20 - length


@pytest.mark.slow
def test_residuals_of_points_and_of_two_cameras_are_those_of_one_device():
    problem = support.tiny()
    camera = problem.camera_index[::5]
    point = problem.point_index[::5]
    rows = depth(
        pose=camera, point=point, image=camera, measured=-geometry.depths(problem)[::5] * 1.01
    )
    problem = jaxba.with_residual(
        problem, rows, unknowns={"image": np.ones((6, 1))}, loss=jaxba.Loss("huber")
    )
    centers = geometry.camera_centers(problem.cameras)
    measured = centers[[0, 1, 2, 3]] - centers[[1, 2, 3, 5]] + 0.01
    rows = apart(pose=[0, 1, 2, 3], pose_2=[1, 2, 3, 5], size=0, measured=measured)
    # one number of all cameras
    problem = jaxba.with_residual(problem, rows, unknowns={"size": [[1.1]]})
    problem = jaxba.with_residual(problem, bar(point=[0, 1, 2], point_2=[3, 2, 9], length=60.0))
    several = compare(problem, "ceres", linear_solver="implicit")
    images, size = several.problem.residuals.blocks
    assert (images != 1).all()
    assert size != 1.1


@pytest.mark.parametrize(
    ("linear_solver", "policy"),
    [
        pytest.param("explicit", "ceres+embedded", marks=pytest.mark.slow),
        ("sparse", "ceres"),
        pytest.param("implicit", "ceres+refine1", marks=pytest.mark.slow),
        pytest.param("cg", "ceres", marks=pytest.mark.slow),
    ],
)
def test_costs_of_every_iteration_are_those_of_one_device(linear_solver, policy):
    compare(sequence(), policy, linear_solver=linear_solver)


@pytest.mark.slow
def test_a_dense_product_and_a_far_scene_with_odd_observations_are_divided_too():
    problem = support.odd()
    away = np.array([4000.0, 0.0, -3000.0])
    cameras = np.array(problem.cameras)
    cameras[:, 3:6] -= np.einsum("nij,j->ni", geometry.rotation_matrices(cameras[:, :3]), away)
    found = compare(problem.replace(cameras=cameras, points=problem.points + away), "ceres")
    # points that nobody sees stay, and so do cameras
    np.testing.assert_array_equal(found.problem.points[[40, 42]], (problem.points + away)[[40, 42]])
    np.testing.assert_array_equal(found.problem.cameras[6], cameras[6])
    compare(support.tiny(), "learned", dtype="float32", rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("linear_solver", ["explicit", "implicit"])
def test_lenses_constants_and_priors_are_divided_too(linear_solver):
    problem = general()
    found = compare(problem, "ceres+refine1", linear_solver=linear_solver).problem
    assert support.same_bits(found.points[[3, 17]], problem.points[[3, 17]])
    assert support.same_bits(found.cameras[2, :6], problem.cameras[2, :6])
    assert support.same_bits(found.cameras[[0, 1, 5], 6:], np.tile(found.cameras[0, 6:], (3, 1)))


@pytest.mark.parametrize(
    ("policy", "devices"),
    [
        ("ceres", None),
        *(
            pytest.param(*one, marks=pytest.mark.slow)
            for one in [("guarded", None), ("ceres", DEVICES)]
        ),
    ],
)
def test_parts_of_a_device_are_computed_one_after_the_other_with_the_same_costs(
    policy, devices, monkeypatch
):
    problem = general() if policy == "guarded" else sequence()
    options = SolveOptions(linear_solver="implicit", max_iterations=6, devices=devices)
    whole = solve(problem, policy, options)
    monkeypatch.setattr(sharded, "LARGE", 1)
    monkeypatch.setattr(sharded, "PART", problem.num_observations // 7)
    monkeypatch.setattr(sharded, "PART_OF_CAMERA", 0)
    setup = set_up(problem, policy, options, in_parts=True)
    assert setup.shards is not None
    assert setup.shards.in_parts
    assert setup.shards.layout.slot_camera.shape[1] > 1  # of each device
    in_parts = solve(problem, policy, options)
    np.testing.assert_allclose(in_parts.history.cost, whole.history.cost, rtol=1e-9)
    np.testing.assert_allclose(
        geometry.cost(in_parts.problem), geometry.cost(whole.problem), rtol=1e-9
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("first", "second", "policy"),
    [(0, 3, "ceres+refine2"), (range(149), range(1, 150), "ceres")],
    ids=["rows_of_one_part", "a_row_between_all_points"],
)
def test_rows_of_two_points_may_be_in_one_part_alone(first, second, policy, monkeypatch):
    problem = jaxba.with_residual(
        sequence(), bar(point=first, point_2=second, length=60.0), loss=jaxba.Loss("huber")
    )
    options = SolveOptions(linear_solver="implicit", max_iterations=4)
    whole = solve(problem, policy, options)
    monkeypatch.setattr(sharded, "LARGE", 1)
    monkeypatch.setattr(sharded, "PART", problem.num_observations // 7)
    monkeypatch.setattr(sharded, "PART_OF_CAMERA", 0)
    in_parts = solve(problem, policy, options)
    np.testing.assert_allclose(in_parts.history.cost, whole.history.cost, rtol=1e-9)


def test_a_large_problem_of_many_cameras_has_a_part_at_least(monkeypatch):
    problem = sequence()
    options = StepOptions(linear_solver="implicit")
    monkeypatch.setattr(sharded, "LARGE", 1)
    monkeypatch.setattr(sharded, "PART_OF_CAMERA", problem.num_observations)
    assert sharded.num_parts(problem, options, 1) == sharded.num_parts(problem, options, 2) == 1
    monkeypatch.setattr(sharded, "PART_OF_CAMERA", 0)
    monkeypatch.setattr(sharded, "PART", problem.num_observations // 7)
    assert sharded.num_parts(problem, options, 1) >= 7
    assert sharded.num_parts(problem, StepOptions(linear_solver="explicit"), 1) == 1


@pytest.mark.slow
def test_a_callback_sees_the_same_iterations_and_stops():
    problem = sequence()
    records = []
    options = SolveOptions(linear_solver="implicit", devices=DEVICES, max_iterations=6)
    found = solve(
        problem,
        "ceres",
        options,
        callback=lambda record: records.append(record) or len(records) == 3,
    )
    assert found.iterations == 3
    assert found.termination.reason == "stopped by the caller"
    one = solve(problem, "ceres", SolveOptions(linear_solver="implicit", max_iterations=3))
    np.testing.assert_allclose(
        [record.step.cost for record in records], one.history.cost, rtol=1e-10
    )


def test_every_observation_is_on_one_device_and_each_has_its_share():
    problem = support.odd()
    tracks = np.bincount(problem.point_index, minlength=problem.num_points)
    dealt = deal_points(problem, DEVICES)
    assert sorted(np.concatenate(dealt)) == np.flatnonzero(tracks).tolist()
    shares = [int(tracks[points].sum()) for points in dealt]
    assert max(shares) - min(shares) <= tracks.max()
    options = StepOptions(linear_solver="sparse")
    layouts = sharded_layout(shards_of(problem, dealt), options)
    shapes = [[np.shape(leaf) for leaf in jax.tree.leaves(layout)] for layout in layouts]
    assert shapes[0] == shapes[1] == shapes[2]
    found = Counter()
    for layout, points in zip(layouts, dealt, strict=True):
        order = np.asarray(layout.points)
        mask = np.asarray(layout.slot_mask)
        own = points[order[np.asarray(layout.slot_point)[mask]]]
        camera = np.asarray(layout.slot_camera)[mask]
        pixels = np.asarray(layout.pixels)[:, mask]
        found.update(zip(camera.tolist(), own.tolist(), *pixels.tolist(), strict=True))
    index = problem.camera_index.tolist(), problem.point_index.tolist()
    assert found == Counter(zip(*index, *problem.observations.T.tolist(), strict=True))


@pytest.mark.parametrize(
    ("linear_solver", "policy", "stated"),
    [
        ("explicit", "ceres", 9),
        pytest.param("implicit", "ceres", 11, marks=pytest.mark.slow),
        pytest.param("explicit", "guarded", 15, marks=pytest.mark.slow),
    ],
)
def test_an_iteration_has_the_stated_number_of_sums_over_devices(linear_solver, policy, stated):
    setup = set_up(sequence(), policy, SolveOptions(linear_solver=linear_solver, devices=DEVICES))
    limit = np.asarray(5, np.int32)
    carry = setup.shards.begin(setup.policy, limit)
    given = setup.shards.layout, carry, setup.policy, Tolerances(), limit
    text = _run.lower(*given, **setup.shards.static, length=0).as_text()
    assert text.count("stablehlo.all_reduce") == stated


def test_what_several_devices_cannot_do_is_one_line():
    problem = support.single()
    with pytest.raises(ProblemError, match="3 devices are more than there are observed points"):
        solve(problem, "ceres", SolveOptions(devices=DEVICES))
    with pytest.raises(ProblemError, match="several devices are for plain LM, not for deeplm"):
        solve(support.tiny(), "ceres", SolveOptions(devices=DEVICES, method="deeplm"))
    with pytest.raises(ProblemError, match="prepare is for one device"):
        jaxba.prepare(support.tiny(), "ceres", SolveOptions(devices=DEVICES))
    with pytest.raises(ValueError, match="devices must be"):
        SolveOptions(devices=0)


WAITING = "note: waiting for the other processes"
"""What a process says on a machine so busy that the other one is slow to start."""


def start_two(file, *options: str, stderr: int = subprocess.STDOUT) -> list[subprocess.Popen]:
    """Two processes that solve a file."""
    with socket.socket() as free:
        free.bind(("localhost", 0))
        address = f"localhost:{free.getsockname()[1]}"
    command = [
        sys.executable,
        "-c",
        "from jaxba.cli.solve import main; main()",
        str(file),
        *options,
    ]
    command += ["--linear-solver", "implicit", "--compilation", "full"]
    ends = ["--coordinator", address, "--processes", "2", "--process"]
    environment = {**os.environ, "JAX_PLATFORMS": "cpu"}

    def start(k):
        return subprocess.Popen(
            [*command, *ends, str(k)], env=environment, stdout=subprocess.PIPE, stderr=stderr
        )

    return [start(k) for k in range(2)]


def run_two(file, output, *options: str) -> tuple[list[int], list[str]]:
    """Exit statuses of two processes that solve a file, and what they print."""
    started = start_two(
        file, "--policy", "ceres", "--max-iterations", "4", "--output", str(output), *options
    )
    try:
        printed = [process.communicate(timeout=240)[0].decode() for process in started]
    finally:
        for process in started:
            process.kill()
    return [process.returncode for process in started], printed


@pytest.mark.slow
def test_two_processes_solve_as_one_and_end_together(tmp_path):
    file = tmp_path / "scene.txt"
    problem = sequence()
    jaxba.write_problem(problem, file)
    statuses, printed = run_two(file, tmp_path / "nowhere" / "out.txt")
    assert statuses == [2, 2]
    assert "nowhere" in printed[0]
    (tmp_path / "more.yaml").write_text("distances: [{points: [0, 9], length: 2, stddev: 0.1}]\n")
    statuses, printed = run_two(
        file, tmp_path / "out.txt", "--constraints", str(tmp_path / "more.yaml")
    )
    assert statuses == [0, 0], printed
    assert "4 iterations" in printed[0]
    # Gloo is C++
    assert {line for line in printed[1].splitlines() if not line.startswith("[Gloo]")} <= {WAITING}
    bars = jaxba.residuals.distance(point=0, point_2=9, length=2.0, sigma=0.1)
    problem = jaxba.with_residual(jaxba.read_problem(file), bars)
    one = solve(problem, "ceres", SolveOptions(linear_solver="implicit", max_iterations=4)).costs[
        "pixels"
    ]
    np.testing.assert_allclose(
        geometry.cost(jaxba.read_problem(tmp_path / "out.txt")), one, rtol=1e-9
    )
    statuses, printed = run_two(file, tmp_path / "start.txt", "--seconds", "1e-6")
    assert statuses == [0, 0], printed
    assert "not converged: time limit" in printed[0]


@pytest.mark.slow
def test_a_process_that_dies_ends_the_other_with_one_line(tmp_path):
    file = tmp_path / "scene.txt"
    jaxba.write_problem(sequence(), file)
    # lambda so large that no rule of stopping is met
    started = start_two(
        file, "--policy", "constant:1e9", "--max-iterations", "1000000", stderr=subprocess.PIPE
    )
    try:
        assert started[0].stdout is not None
        while started[0].stdout.readline().split()[:1] != [b"3"]:
            assert started[0].poll() is None
        started[1].kill()
        _, errors = started[0].communicate(timeout=240)
    finally:
        for process in started:
            process.kill()
            process.communicate()
    lines = [line for line in errors.decode().splitlines() if line != WAITING]
    assert lines == ["error: another process of this run has ended, and so does this one"]
    assert started[0].returncode == 2


def test_a_process_whose_fellows_never_start_ends_with_one_line():
    code = "from jaxba.runtime import distributed as d; d.PATIENCE_S, d.START_S = 0.1, 1; "
    with socket.socket() as free:
        free.bind(("localhost", 0))
        port = free.getsockname()[1]
    code += f"d.initialize('localhost:{port}', 2, 0)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=240)
    assert done.returncode == 2
    assert done.stderr.splitlines() == [
        WAITING,
        "error: not all processes of this run have started in 1 s",
    ]
