"""What a notebook shows of a problem and a solution."""

from __future__ import annotations

import base64
import re
from io import BytesIO

import numpy as np
import pytest
import support

import jaxba


@pytest.fixture(scope="module")
def solution():
    return jaxba.solve(support.tiny())


def picture(html: str) -> np.ndarray:
    from PIL import Image

    (data,) = re.findall(r'src="data:image/png;base64,([^"]+)"', html)
    return np.asarray(Image.open(BytesIO(base64.b64decode(data))).convert("RGB"), int)


def test_a_solution_is_one_short_line(solution):
    assert re.fullmatch(
        r"Solution\(converged: .* within ftol, cost: .* -> .*, iterations: .*\)", repr(solution)
    )
    assert len(repr(solution)) < 200


def test_a_notebook_shows_a_table_and_the_scene_from_above(solution):
    html = solution.problem._repr_html_()
    assert "6 cameras<br>40 points<br>200 observations" in html
    rmse = np.sqrt(2 * solution.final_cost / 200)
    assert f"{rmse:.4g} px" in html
    orange = np.abs(picture(html) - [0xD5, 0x5E, 0x00]).max(axis=2) < 30
    assert orange.any()


def test_a_notebook_shows_a_solution_with_its_curves(solution):
    html = solution._repr_html_()
    assert "<td>6 cameras<br>40 points<br>200 observations<tr>" in html
    assert f"{solution.initial_cost:.6g} -&gt; {solution.final_cost:.6g}" in html
    assert (np.abs(picture(html) - [0x00, 0x72, 0xB2]).max(axis=2) < 30).any()
    assert solution.plot()._repr_png_().startswith(b"\x89PNG")


def test_names_of_functions_are_text_and_a_problem_needs_no_points():
    problem = jaxba.random_scene(jaxba.SceneConfig(cameras=4, points=30), 0)
    first = jaxba.residual(lambda point: point)(point=[0])
    html = jaxba.with_residual(problem, first)._repr_html_()
    assert "&lt;lambda&gt;" in html
    graph = jaxba.BundleProblem.create(problem.cameras)
    assert "0 points" in graph._repr_html_()
