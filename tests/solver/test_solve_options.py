"""The one table of defaults: what is asked for, what a policy brings, and what the command does
with it."""

from __future__ import annotations

import inspect
import json
from dataclasses import fields

import chex
import pytest
import support

import jaxba
from jaxba import (
    Coordinates,
    Loss,
    ProblemError,
    Refinement,
    SceneConfig,
    SolveOptions,
    Tolerances,
    make_policy,
    prepare,
)
from jaxba.cli.solve import Arguments, run, solve_options
from jaxba.damping.policy import trained_step
from jaxba.io import read_problem, write_problem
from jaxba.solver.names import parse_solver
from jaxba.solver.prepare import DEFAULT_POLICY

# Defaults


def test_every_default_of_the_command_is_that_of_the_options():
    command = Arguments()
    options = SolveOptions()
    plain = {field.name for field in fields(Arguments)} & {
        field.name for field in fields(SolveOptions)
    } - {"loss"}
    for name in plain - {"pad"}:
        assert getattr(command, name) == getattr(options, name), name
    assert (command.pad, options.pad) == ("auto", None)
    assert command.preconditioner == options.conjugate_gradients.preconditioner
    assert (command.loss, command.loss_scale) == (options.loss.rho, options.loss.scale)
    assert (command.ftol, command.xtol, command.gtol) == options.tolerances[:3]
    assert options.refinement is command.refine_points is None
    assert options.coordinates is command.scaling is command.rotation is None
    grouped = {"conjugate_gradients", "loss", "tolerances", "refinement", "coordinates"}
    assert {field.name for field in fields(SolveOptions)} == plain | grouped


def test_the_command_asks_for_the_same_step():
    policy, options = solve_options(Arguments())
    assert options.step_options(policy) == SolveOptions().step_options(make_policy(DEFAULT_POLICY))


@pytest.mark.parametrize("function", [jaxba.solve, jaxba.solve_and_retriangulate, jaxba.prepare])
def test_who_chooses_lambda_is_the_same_everywhere(function):
    assert (
        inspect.signature(function).parameters["policy"].default
        == Arguments().policy
        == DEFAULT_POLICY
    )


def test_a_solve_with_defaults_is_what_the_command_writes(tmp_path):
    start, written, expected = (
        tmp_path / name for name in ("start.txt", "written.txt", "expected.txt")
    )
    write_problem(support.tiny(), start)
    assert run([str(start), "--output", str(written)]) == 0
    write_problem(jaxba.solve(read_problem(start)).problem, expected)
    assert written.read_bytes() == expected.read_bytes()


# What a policy was trained with


def test_a_loss_leaves_the_step_that_the_policy_was_trained_with():
    trained = trained_step(make_policy("bold"))
    assert trained.refinement != Refinement()
    found = prepare(support.tiny(), "bold", SolveOptions(loss=Loss("huber", 2.0))).options
    assert found.loss == Loss("huber", 2.0)
    assert (found.refinement, found.coordinates) == (trained.refinement, trained.coordinates)


def test_a_solve_with_a_loss_is_the_one_with_the_trained_step_spelled_out():
    trained = trained_step(make_policy("bold"))
    loss = Loss("huber", 2.0)
    spelled_out = SolveOptions(
        loss=loss, refinement=trained.refinement, coordinates=trained.coordinates
    )
    found, expected = (
        jaxba.solve(support.tiny(), "bold", o) for o in (SolveOptions(loss=loss), spelled_out)
    )
    chex.assert_trees_all_equal(found.history, expected.history, strict=True)


def test_what_is_asked_for_wins_over_what_the_policy_was_trained_with():
    refinement = Refinement(points=1, trials=2)
    coordinates = Coordinates(rotation="manifold")
    trained = trained_step(make_policy(DEFAULT_POLICY))
    one = prepare(support.tiny(), options=SolveOptions(refinement=refinement)).options
    assert (one.refinement, one.coordinates) == (refinement, trained.coordinates)
    other = prepare(support.tiny(), options=SolveOptions(coordinates=coordinates)).options
    assert (other.refinement, other.coordinates) == (trained.refinement, coordinates)


def test_a_rule_brings_a_plain_step():
    found = prepare(support.tiny(), "ceres").options
    assert (found.refinement, found.coordinates) == (Refinement(), Coordinates())


# Embedded iterations in the name of the policy


@pytest.mark.parametrize("name", ["ceres+embedded", "constant:1e-4+refine2", "learned+refine0"])
def test_the_name_of_a_policy_brings_the_embedded_iterations_of_the_solver_of_that_name(
    name, tmp_path
):
    path = tmp_path / "problem.txt"
    log = tmp_path / "log.json"
    write_problem(support.tiny(), path)
    problem = read_problem(path)
    expected = jaxba.solve(problem, *parse_solver(name).build()).history
    chex.assert_trees_all_equal(jaxba.solve(problem, name).history, expected)
    assert run([str(path), "--policy", name, "--log", str(log)]) == 0
    record = json.loads(log.read_text())
    assert record["solver"] == name
    assert [point["lambda"] for point in record["trace"][1:]] == expected.damping.tolist()
    assert [point["cost"] for point in record["trace"][1:]] == expected.cost.tolist()


def test_the_name_of_a_policy_brings_the_coordinates_unless_they_are_given():
    built = parse_solver("ceres+embedded").build()[1]
    found = prepare(support.tiny(), "ceres+embedded").options
    assert (found.refinement, found.coordinates) == (built.refinement, built.coordinates)
    assert built.coordinates != Coordinates()
    given = prepare(
        support.tiny(), "ceres+embedded", SolveOptions(coordinates=Coordinates())
    ).options
    assert (given.refinement, given.coordinates) == (built.refinement, Coordinates())


def test_options_may_repeat_the_name_of_the_policy_and_not_contradict_it(capsys):
    same = Refinement(points=3)
    assert (
        prepare(support.tiny(), "ceres+refine3", SolveOptions(refinement=same)).options.refinement
        == same
    )
    with pytest.raises(ValueError, match=r"policy 'ceres\+refine3' states its refinement"):
        jaxba.solve(support.tiny(), "ceres+refine3", SolveOptions(refinement=Refinement(points=2)))
    assert solve_options(Arguments(policy="ceres+refine3", refine_points=3))[1].refinement == same
    for policy in ("ceres+refine3", "ceres+embedded"):
        assert run(["--policy", policy, "--refine-points", "2"]) == 2
        assert (
            capsys.readouterr().err == f"error: --refine-points 2 contradicts --policy {policy}\n"
        )


# What is refused


@pytest.mark.parametrize("asked", [{"linear_solver": "explicit"}, {"intrinsics": "fixed"}], ids=str)
def test_a_factorisation_that_does_not_fit_the_memory_is_refused(asked, monkeypatch):
    scene = jaxba.random_scene(SceneConfig(cameras=50, points=500, observations=2000), 0)
    monkeypatch.setattr("os.sysconf", lambda name: 1000)  # 1000 pages of 1000 bytes
    with pytest.raises(ProblemError, match="50 cameras take some 0 GB to solve by a factorisation"):
        jaxba.solve(scene, "ceres", SolveOptions(**asked))


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        ({"dtype": "float16"}, "dtype must be one of float64, float32, mixed, not 'float16'"),
        (
            {"linear_solver": "power"},
            "linear_solver must be one of auto, explicit, sparse, implicit, cg, not 'power'",
        ),
        ({"compilation": "fast"}, "compilation must be one of"),
        ({"intrinsics": "shared"}, "intrinsics must be one of free, fixed, not 'shared'"),
        ({"method": "magic"}, "unknown method 'magic'; known: lm, stba, deeplm"),
        ({"method": 3}, "method must be an entry of jaxba.METHODS or its name, is 3"),
        ({"refinement": 3}, "refinement must be made with jaxba.Refinement, is 3"),
        ({"loss": "huber"}, "loss must be made with jaxba.Loss, is 'huber'"),
        ({"loss": None}, "loss must be made with jaxba.Loss, is None"),
        ({"tolerances": 1e-6}, "tolerances must be made with jaxba.Tolerances, is 1e-06"),
        ({"max_iterations": -1}, "max_iterations must be at least 0"),
        ({"tolerances": Tolerances(xtol=-1.0)}, "xtol must not be negative, is -1"),
    ],
)
def test_options_are_checked_where_they_are_made(asked, message, unchecked):
    with pytest.raises(ValueError, match=message):
        SolveOptions(**asked)


@pytest.mark.parametrize("function", [jaxba.solve, jaxba.solve_and_retriangulate, jaxba.prepare])
def test_options_that_are_none_are_refused(function, unchecked):
    with pytest.raises(
        ValueError, match=r"options must be made with jaxba.SolveOptions, are 'ceres'"
    ):
        function(support.tiny(), options="ceres")


def test_a_path_is_no_problem(unchecked):
    with pytest.raises(
        ValueError,
        match=r"problem must be a BundleProblem, as jaxba.read_problem returns it, not 'a",
    ):
        jaxba.solve("a.txt")


def test_options_are_hashable_so_that_they_can_be_keys():
    assert (
        len(
            {
                SolveOptions(),
                SolveOptions(),
                SolveOptions(method="deeplm"),
                SolveOptions(loss=Loss("huber")),
            }
        )
        == 3
    )


@pytest.mark.parametrize(
    ("keywords", "advice"),
    [
        ({"max_iterations": 5}, r"options=jaxba.SolveOptions\(max_iterations=...\)"),
        ({"ftol": 1e-3}, r"SolveOptions\(tolerances=jaxba.Tolerances\(ftol=...\)\)"),
        ({"max_iteration": 5}, r"did you mean options=jaxba.SolveOptions\(max_iterations=...\)\?"),
        ({"callbak": print}, "no argument callbak$"),
    ],
)
def test_an_option_given_as_an_argument_is_named_with_its_place(keywords, advice):
    problem = jaxba.random_scene(jaxba.SceneConfig(4, 30, 100), 0)
    with pytest.raises(TypeError, match=advice):
        jaxba.solve(problem, **keywords)
