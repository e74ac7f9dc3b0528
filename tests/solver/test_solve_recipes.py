"""Recipes side by side: each ends as it does alone, and the lowest end wins."""

from __future__ import annotations

import pytest
import support

import jaxba
from jaxba.cli.solve import run
from jaxba.solver.recipes import RECIPES


def test_each_recipe_ends_as_it_does_alone():
    problem = support.tiny()
    together = jaxba.solve_recipes(problem, 2, "bold")
    alone = [jaxba.solve(problem, policy) for policy in ("bold", RECIPES[1])]
    ends = [solution.final_cost for solution in alone]
    assert [solution.final_cost for solution in together] == pytest.approx(ends, rel=1e-9)


def test_recipes_beside_a_rule_have_their_own_refinement(tmp_path, capsys):
    path = tmp_path / "p.txt"
    jaxba.write_bal(support.tiny(), path)
    assert run([str(path), "--policy", "ceres", "--recipes", "2"]) == 0
    lines = [
        line.split()
        for line in capsys.readouterr().out.splitlines()
        if line.startswith(("ceres: ", RECIPES[1]))
    ]
    alone = [
        jaxba.solve(jaxba.read_problem(path), policy).final_cost for policy in ("ceres", RECIPES[1])
    ]
    assert [float(line[2]) for line in lines] == pytest.approx(alone, rel=1e-5)


@pytest.mark.parametrize("count", [0, len(RECIPES) + 1])
def test_there_are_only_so_many(count):
    with pytest.raises(ValueError, match=f"there are 1 to {len(RECIPES)} recipes, not {count}"):
        jaxba.solve_recipes(support.tiny(), count)


def test_the_command_writes_the_lowest_end_and_names_all(tmp_path, capsys):
    jaxba.write_bal(support.tiny(), tmp_path / "p.txt")
    assert (
        run([str(tmp_path / "p.txt"), "--recipes", "2", "--output", str(tmp_path / "s.txt")]) == 0
    )
    shown = capsys.readouterr().out
    assert f"\n{RECIPES[0]}: cost " in shown
    assert f"\n{RECIPES[1]}: cost " in shown
    ends = [float(line.split()[2]) for line in shown.splitlines() if line.startswith(RECIPES[:2])]
    written = jaxba.solve(
        jaxba.read_problem(tmp_path / "s.txt"), options=jaxba.SolveOptions(max_iterations=0)
    )
    assert written.initial_cost == pytest.approx(min(ends), rel=1e-5)
    assert run([str(tmp_path / "p.txt"), "--recipes", "2", "--log", str(tmp_path / "l.json")]) == 2
    assert "for one policy, not for --recipes" in capsys.readouterr().err
    assert run([str(tmp_path / "p.txt"), "--recipes", "9"]) == 2
    found = capsys.readouterr()
    assert not found.out
    assert found.err.startswith("error: --recipes must be 2 to ")
