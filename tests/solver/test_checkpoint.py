"""A solve that was stopped or killed continues from its checkpoint and ends as if nothing had
happened."""

from __future__ import annotations

import errno
import types
from dataclasses import replace

import numpy as np
import pytest
import support

import jaxba
from jaxba import ProblemError, SolveOptions, solve
from jaxba.problem import geometry
from jaxba.problem.labels import Labels
from jaxba.solver import checkpoint, sharded

OPTIONS = SolveOptions(
    linear_solver="implicit", max_iterations=8, tolerances=jaxba.Tolerances(ftol=0.0)
)


class Killed(Exception):
    """Raised in the middle of a solve."""


def killed_after(count: int):
    def callback(record):
        if record.iteration == count:
            raise Killed
        return False

    return callback


@pytest.mark.parametrize("in_parts", [False, pytest.param(True, marks=pytest.mark.slow)])
@pytest.mark.parametrize("policy", ["ceres", pytest.param("guarded", marks=pytest.mark.slow)])
def test_a_solve_that_was_killed_continues_to_the_same_end(
    policy, in_parts, tmp_path, monkeypatch, capsys
):
    problem = support.tiny()
    file = tmp_path / "solve.npz"
    monkeypatch.setattr(checkpoint, "EVERY_S", 0.0)
    if in_parts:
        monkeypatch.setattr(sharded, "LARGE", 1)
        monkeypatch.setattr(sharded, "PART", problem.num_observations // 3)
        monkeypatch.setattr(sharded, "PART_OF_CAMERA", 0)
    whole = solve(problem, policy, OPTIONS)
    with pytest.raises(Killed):
        solve(problem, policy, OPTIONS, checkpoint=file, callback=killed_after(4))
    assert file.exists()
    numbers = []
    found = solve(
        problem,
        policy,
        OPTIONS,
        checkpoint=file,
        callback=lambda one: numbers.append(one.iteration),
        verbose=True,
    )
    told = capsys.readouterr().out
    assert "goes on after 3 iterations" in told
    assert [int(line.split()[0]) for line in told.splitlines() if line[:4].strip().isdigit()][
        :2
    ] == [3, 4]
    assert numbers[0] == 4
    assert found.initial_cost == pytest.approx(whole.initial_cost, rel=1e-12)
    for name in ("cost", "damping", "accepted"):
        ours, theirs = (getattr(one.history, name) for one in (found, whole))
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    assert geometry.cost(found.problem) == pytest.approx(whole.final_cost, rel=1e-9)


def test_numbers_of_residuals_are_in_it_and_more_iterations_may_follow(tmp_path):
    problem = support.tiny()
    file = tmp_path / "solve.npz"
    problem = jaxba.with_residual(
        problem, scaled(size=0, pose=[0, 1], measured=0.5), unknowns={"size": [[1.0]]}
    )
    stopped = solve(
        problem, "ceres", OPTIONS, checkpoint=file, callback=lambda record: record.iteration == 3
    )
    assert stopped.iterations == 3
    more = SolveOptions(
        linear_solver="implicit", max_iterations=12, tolerances=jaxba.Tolerances(ftol=0.0)
    )
    found = solve(problem, "ceres", more, checkpoint=file)
    whole = solve(problem, "ceres", more)
    assert found.iterations == whole.iterations
    np.testing.assert_allclose(
        found.problem.residuals.blocks[0], whole.problem.residuals.blocks[0], rtol=1e-6
    )


@jaxba.residual
def scaled(size, pose, *, measured):
    return size[0] * pose.center[0] - measured


def test_a_reached_limit_is_not_solved_again_and_networks_differ_by_their_weights(tmp_path):
    problem = support.tiny()
    file = tmp_path / "solve.npz"
    five = replace(OPTIONS, max_iterations=5)
    done, again = (solve(problem, "ceres", five, checkpoint=file) for _ in range(2))
    assert again.iterations == done.iterations == 5
    assert again.termination == done.termination == jaxba.Termination.MAX_ITERATIONS
    assert again.final_cost == pytest.approx(done.final_cost, rel=1e-9)
    none = solve(
        problem, "ceres", SolveOptions(linear_solver="implicit", max_iterations=0), checkpoint=file
    )
    assert none.final_cost == pytest.approx(done.final_cost, rel=1e-9)
    learned = jaxba.make_policy("learned")
    first, *others = learned.layers
    other = replace(learned, layers=(first._replace(bias=first.bias + 1), *others))
    options = SolveOptions(max_iterations=1)
    solve(problem, learned, options, checkpoint=tmp_path / "learned.npz")
    with pytest.raises(ProblemError, match="the checkpoint of another problem, policy or options"):
        solve(problem, other, options, checkpoint=tmp_path / "learned.npz")


def test_a_checkpoint_of_something_else_is_refused_in_one_line(tmp_path):
    problem = support.tiny()
    file = tmp_path / "solve.npz"
    options = SolveOptions(max_iterations=1)
    solve(problem, "ceres", options, checkpoint=file)
    for other, policy in (
        (problem.replace(points=problem.points + 1e-3), "ceres"),
        (problem, "nielsen"),
    ):
        with pytest.raises(
            ProblemError, match=r"solve.npz is the checkpoint of another problem, policy or options"
        ):
            solve(other, policy, options, checkpoint=file)
    whole = file.read_bytes()
    array = tmp_path / "array.npy"
    np.save(array, np.zeros(3))
    # of the last member
    compression = whole.rindex(b"PK\x01\x02") + 10
    flags = whole.rindex(b"PK\x01\x02") + 8
    flipped = [whole[:at] + b"\x01" + whole[at + 1 :] for at in (compression, flags)]
    for damaged in (whole[:100], array.read_bytes(), *flipped):
        file.write_bytes(damaged)
        with pytest.raises(ProblemError, match=r"solve.npz is no checkpoint"):
            solve(problem, "ceres", options, checkpoint=file)
    with pytest.raises(ProblemError, match="cannot write"):
        solve(problem, "ceres", options, checkpoint=tmp_path / "missing" / "solve.npz")


def test_a_solve_whose_checkpoint_cannot_be_written_goes_on(tmp_path, monkeypatch):
    def full(path):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(checkpoint, "atomic_write", full)
    options = SolveOptions(max_iterations=2)
    with pytest.warns(
        jaxba.ProblemWarning, match=r"solve.npz: No space left on device; the solve goes on"
    ):
        found = solve(support.tiny(), "ceres", options, checkpoint=tmp_path / "solve.npz")
    assert found.iterations == 2


def own_loss(s):
    return s / (1 + s)


def another_loss():
    def own_loss(s):
        return s / (1 + 0.5 * s)

    return own_loss


def test_another_process_continues_with_a_loss_of_ones_own_and_another_tolerance(tmp_path):
    problem = support.tiny()
    file = tmp_path / "solve.npz"
    options = SolveOptions(max_iterations=2, loss=jaxba.Loss(own_loss, 2.0))
    solve(problem, "ceres", options, checkpoint=file)
    # functions have other addresses in another process
    elsewhere = types.FunctionType(own_loss.__code__, globals(), "own_loss")
    options = replace(options, loss=jaxba.Loss(elsewhere, 2.0), max_iterations=3, within=1e-12)
    numbers = []
    solve(
        problem,
        "ceres",
        options,
        checkpoint=file,
        callback=lambda record: numbers.append(record.iteration),
    )
    assert numbers == [3]
    other = replace(options, loss=jaxba.Loss(another_loss(), 2.0))
    with pytest.raises(ProblemError, match="the checkpoint of another problem, policy or options"):
        solve(problem, "ceres", other, checkpoint=file)


@pytest.mark.slow
def test_functions_and_losses_of_residuals_belong_to_a_checkpoint(tmp_path):
    problem = support.tiny()
    file = tmp_path / "solve.npz"
    rows = scaled(size=0, pose=[0, 1], measured=0.5)
    options = SolveOptions(max_iterations=1)

    def registered(rows, loss):
        return jaxba.with_residual(problem, rows, unknowns={"size": [[1.0]]}, loss=loss)

    solve(registered(rows, jaxba.Loss()), "ceres", options, checkpoint=file)
    for other in (
        registered(rows, jaxba.Loss("cauchy")),
        registered(raised(size=0, pose=[0, 1], measured=0.5), None),
    ):
        with pytest.raises(
            ProblemError, match="the checkpoint of another problem, policy or options"
        ):
            solve(other, "ceres", options, checkpoint=file)


@jaxba.residual
def raised(size, pose, *, measured):
    return size[0] * pose.center[2] - measured


def test_names_of_images_are_there_after_a_solve_continues(tmp_path):
    labels = Labels(tuple("abcdef"), np.arange(6), np.arange(6), np.arange(40))
    problem = support.tiny().replace(labels=labels)
    file = tmp_path / "solve.npz"
    for limit in (1, 2):
        found = solve(problem, "ceres", SolveOptions(max_iterations=limit), checkpoint=file)
        assert found.problem.labels == labels
