"""What the viewer says: sizes, the worst images and rows, how well an image or a point fits."""

from __future__ import annotations

import html
import re

import numpy as np

from jaxba.model.registration import costs_of_rows
from jaxba.viewer.stage import ERROR, FILE, KINDS, Stage

# images in the list of the worst; rows of a residual, and images that see a point
WORST = 20
WORST_ROWS = 5


def plain(name: str) -> str:
    """A name as Markdown that means just its characters: viser renders HTML and Markdown as they
    come."""
    return re.sub(r"([\\`*_{}\[\]()#+.!|~>-])", r"\\\1", html.escape(name)) if name else name


def sizes(stage: Stage) -> str:
    """Sizes of what is shown, and how much of it."""
    recording = stage.shown.recording
    problem = stage.shown.problem

    def part(shown, whole):
        return f"{shown:,}" if shown == whole else f"{shown:,} of {whole:,}"

    images = part(len(stage.frusta), problem.num_cameras)
    points = part(len(stage.points), recording.whole)
    of = " of these points" if recording.whole > problem.num_points else ""
    return f"{images} images, {points} points, {problem.num_observations:,} observations{of}"


def worst_images(stage: Stage, count: int = WORST) -> list[tuple[str, int]]:
    """The worst images: a line of text for each, and its number."""
    return [(entry(stage, camera), camera) for camera in stage.measures.worst()[:count].tolist()]


def entry(stage: Stage, camera: int) -> str:
    """An image in the list: its error, name and observations."""
    measures = stage.measures
    return (
        f"{measures.of_image[camera]:.3g} px: {stage.shown.name_of(camera)} "
        f"({measures.seen[camera]:,})"
    )


def numbers(stage: Stage) -> str:
    """The iteration shown, in words: cost, lambda, gain, seconds; of a problem its error."""
    recording = stage.shown.recording
    k = stage.iteration
    error = f"RMSE {stage.measures.rmse:.4g} px"
    if recording.last == 0:
        return error
    if k == 0:
        return f"start, cost {recording.cost[0]:.5g}, {error}"
    how = f"iteration {k} of {recording.last}{'' if recording.accepted[k] else ', rejected'}"
    took = f"gain {recording.gain_ratio[k]:.2g}, {recording.time_s[k]:.3g} s"
    return f"{how}, cost {recording.cost[k]:.5g}, {error}, λ {recording.damping[k]:.2g}, {took}"


def meaning(stage: Stage) -> str:
    """What the colours of points mean; empty for those of the file."""
    if stage.colour == FILE:
        return ""
    low, high = stage.limits[stage.colour]
    unit = "px" if stage.colour == ERROR else "views"
    return f"{stage.colour}, violet: {low:.3g} {unit} or less, yellow: {high:.3g} or more"


def about_rows(stage: Stage) -> list[str]:
    """For each residual besides those of pixels its colour, its cost and its worst rows, at the
    iteration shown."""
    rows = stage.problem.residuals.rows
    lines = []
    for number, costs in enumerate(costs_of_rows(stage.problem) if rows else ()):
        worst = ", ".join(
            f"{row} ({costs[row]:.3g})" for row in np.argsort(-costs, kind="stable")[:WORST_ROWS]
        )
        colour = KINDS[number % len(KINDS)]
        name = plain(rows[number].residual.name)
        cost = f"cost {costs.sum():.5g} of {len(costs):,} rows; the worst: {worst}"
        lines.append(f'<font color="rgb{colour}">●</font> **{name}**: {cost}')
    return lines


def about_image(stage: Stage, camera: int) -> str:
    """How well an image fits."""
    name = plain(stage.shown.name_of(camera))
    measures = stage.measures
    fits = f"{measures.seen[camera]:,} observations, RMSE {measures.of_image[camera]:.3g} px"
    drawn = "times as long as they are, in all images, from the measured pixel to the predicted one"
    return f"**{name}**: {fits}. Residuals are drawn {stage.magnified:.3g} {drawn}."


def about_track(stage: Stage, point: int) -> str:
    """Where a point is seen, and how far from its prediction, the worst first."""
    rows = np.flatnonzero(np.asarray(stage.problem.point_index) == point)
    errors = np.linalg.norm(stage.measures.residuals[rows], axis=1)
    order = np.argsort(-errors, kind="stable")[:WORST_ROWS]

    def name(row):
        return plain(stage.shown.name_of(int(stage.problem.camera_index[row])))

    seen = ", ".join(f"{errors[k]:.3g} px in {name(rows[k])}" for k in order)
    return (
        f"**point {point}**: {len(rows)} images, RMSE {stage.measures.of_point[point]:.3g} px; "
        f"the worst: {seen}"
    )
