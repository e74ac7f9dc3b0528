"""Examples do what they say."""

from __future__ import annotations

import json
import runpy
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

EXAMPLES = Path(__file__).parent.parent / "examples"


@pytest.mark.slow
def test_the_notebook_learns_weights_that_bring_held_out_points_nearer_to_the_truth(capsys):
    cells = json.loads((EXAMPLES / "learn_sigma.ipynb").read_text())["cells"]
    names: dict = {}
    for cell in cells:
        if cell["cell_type"] == "code":
            exec("".join(cell["source"]), names)
    assert "held-out error" in capsys.readouterr().out
    assert names["after"] < 0.8 * names["before"]


@pytest.mark.slow
def test_a_graph_of_exact_relative_poses_is_solved_and_written(tmp_path):
    random = np.random.default_rng(0)
    count = 6
    turns = Rotation.random(count, rng=0)
    places = random.standard_normal((count, 3))
    start = places + np.where(np.arange(count) > 0, 0.2, 0.0)[:, None] * random.standard_normal(
        (count, 3)
    )

    def numbers(*parts):
        return " ".join(f"{x:.17g}" for part in parts for x in part)

    lines = [
        f"VERTEX_SE3:QUAT {10 * k} {numbers(start[k], turns[k].as_quat())}" for k in range(count)
    ]
    information = np.diag([4.0] * 3 + [9.0] * 3)[np.triu_indices(6)]
    for k in range(count):
        other = (k + 1) % count
        move = turns[k].inv().apply(places[other] - places[k])
        turn = (turns[k].inv() * turns[other]).as_quat()
        lines.append(f"EDGE_SE3:QUAT {10 * k} {10 * other} {numbers(move, turn, information)}")
    (tmp_path / "graph.g2o").write_text("\n".join(lines))
    example = runpy.run_path(str(EXAMPLES / "pose_graph.py"))
    solution = example["main"](str(tmp_path / "graph.g2o"), str(tmp_path / "solved.g2o"))
    shifted = (start[(np.arange(count) + 1) % count] - start) - (
        places[(np.arange(count) + 1) % count] - places
    )
    # nothing is turned
    assert solution.initial_cost == pytest.approx(0.5 * 4.0 * np.sum(shifted**2))
    assert solution.final_cost < 1e-12
    solved = [line.split() for line in (tmp_path / "solved.g2o").read_text().splitlines()]
    np.testing.assert_allclose(
        [[float(x) for x in words[2:5]] for words in solved[:count]], places, atol=1e-6
    )
    assert solved[count:] == [line.split() for line in lines[count:]]
