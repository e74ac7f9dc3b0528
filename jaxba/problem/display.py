"""What a notebook shows of problems and solutions: a small table beside a picture."""

from __future__ import annotations

import base64
import html
import io
from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from jaxba.problem import geometry
from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.similarity import upright

POINTS = 20_000
RADIUS = 2.5
"""Most points of a picture, and half of its side, where four fifths of the scene lie within 1."""


class Picture(Figure):
    """A figure of matplotlib that notebooks show, also without pyplot."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, format="png", dpi=80)
        return buffer.getvalue()


def card(rows: Mapping[str, str], picture: Picture) -> str:
    """A table of names and values beside a picture, as HTML."""
    data = base64.b64encode(picture._repr_png_()).decode()
    cells = "".join(
        f"<tr><th>{name}<td>{html.escape(text).replace(', ', '<br>')}"
        for name, text in rows.items()
    )
    image = f'<img alt="" style="max-width:24em" src="data:image/png;base64,{data}">'
    style = "display:flex;flex-wrap:wrap;align-items:center"
    return f'<div style="{style}"><table>{cells}</table>{image}</div>'


def card_of(problem: BundleProblem) -> str:
    """The card of a problem: what it holds, and cameras and points from above."""
    counts = repr(problem).partition("(")[2][:-1]
    residuals = np.asarray(problem.observations) - geometry.project(problem)
    square = (residuals[np.isfinite(residuals).all(axis=1)] ** 2).sum(axis=1)
    error = {"RMSE": f"{np.sqrt(square.mean()):.4g} px"} if len(square) else {}
    return card({"problem": counts, **error}, from_above(problem))


def from_above(problem: BundleProblem) -> Picture:
    """Cameras, with their directions, and points, from above."""
    picture = Picture(figsize=(4, 4), layout="constrained")
    axes = picture.subplots()
    similarity = upright(problem)
    points = similarity.points(np.asarray(problem.points)[:: 1 + problem.num_points // POINTS])
    poses = similarity.poses(geometry.camera_poses(problem.cameras))
    axes.plot(points[:, 0], points[:, 1], ",", color="0.5", zorder=0)
    axes.quiver(*poses[:, :2, 3].T, *poses[:, :2, 2].T, color="#D55E00", scale=25, width=0.005)
    axes.set(xlim=(-RADIUS, RADIUS), ylim=(-RADIUS, RADIUS), xticks=[], yticks=[], aspect="equal")
    return picture
