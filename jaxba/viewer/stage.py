"""One problem or recorded solve drawn into a scene of viser: points, frusta, the start, an image chosen.

Every stage has its own similarity to the page, so that solves from other starts stand side by side.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import camera_centers, camera_poses
from jaxba.viewer import geometry
from jaxba.viewer.extra import viser
from jaxba.viewer.layers import Layers
from jaxba.viewer.measures import Measures, colours, limits, measure
from jaxba.viewer.picture import picture_of
from jaxba.viewer.recording import evenly
from jaxba.viewer.sources import Shown

SHOWN_POINTS = 200_000
"""Most points on a page. Software rendering draws them at a few frames a second."""

SHOWN_FRUSTA = 500
"""Most cameras on a page."""

POINT_SIZE = 0.006
"""Of points; scenes have a size of about one."""

ASIDE = 3.0
"""Distance between the middles of neighbouring stages."""

FILE, ERROR, TRACK = "colour of the file", "reprojection error", "track length"
"""What colours of points may mean."""

START, CHOSEN, RESIDUAL = (150, 150, 150), (255, 120, 0), (208, 0, 0)
"""Colours."""

KINDS = ((0, 114, 178), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (213, 94, 0))
"""Colours of residuals besides those of pixels. Source: Okabe and Ito 2008, "Color Universal Design"."""

_CORNERS = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])


class Stage:
    """What a page shows of one problem or solve."""

    def __init__(
        self,
        server: viser.ViserServer,
        shown: Shown,
        key: str = "scene",
        place: int = 0,
        points: int = SHOWN_POINTS,
        on_click: Callable[[int], None] | None = None,
        caption: str = "",
    ) -> None:
        """Draws the last iteration, with at most so many points. `key` is the name in the tree of the scene, `place`
        the number among those side by side; `on_click` is called with the number of an image whose frustum was clicked.
        The caption above the scene is `""`, `"name"`, or `"numbers"` with those of the iteration."""
        self.shown, self._server, self._on_click = shown, server, on_click
        self._caption, recording = caption, shown.recording
        self.iteration, self.colour, self.chosen = recording.last, self.colour_choices()[0], None
        self.points = evenly(shown.problem.num_points, points)
        self.frusta = evenly(shown.problem.num_cameras, SHOWN_FRUSTA)
        last = recording.at(recording.last)
        self._similarity = geometry.to_page(last)
        self._measured: tuple[int, Measures] | None = None
        self._set_limits()
        self.image_planes = geometry.frusta_of(last, None if shown.looks is None else shown.looks.sizes)
        self._size = self._size_of_frusta(last)
        self.layers = Layers(server, f"/{key}", (ASIDE * place, 0.0, 0.0))
        self._draw()

    def colour_choices(self) -> list[str]:
        """What colours of points may mean here; the first is shown at the beginning."""
        return [*([FILE] if self._file_colours is not None else []), ERROR, TRACK]

    @property
    def _file_colours(self) -> np.ndarray | None:
        return None if self.shown.looks is None else self.shown.looks.colours

    @property
    def problem(self) -> BundleProblem:
        """The problem at the iteration shown."""
        return self.shown.recording.at(self.iteration)

    @property
    def measures(self) -> Measures:
        """Those of the iteration shown."""
        state = int(self.shown.recording.state[self.iteration])
        if self._measured is None or self._measured[0] != state:
            self._measured = state, measure(self.problem)
        return self._measured[1]

    def show(self, iteration: int | None = None, colour: str | None = None, shown: Shown | None = None) -> None:
        """Shows another iteration, other colours, or a recording that has grown."""
        self.shown = shown or self.shown
        self.iteration = self.iteration if iteration is None else min(iteration, self.shown.recording.last)
        self.colour = self.colour if colour is None or colour not in self.colour_choices() else colour
        if shown is not None:
            self._set_limits()
        self._draw()

    def choose(self, camera: int | None) -> None:
        """Marks an image: its points, and its residuals as segments in its plane."""
        self.chosen = camera
        self._draw()

    def load_images(self) -> int:
        """Puts images into the frusta, and returns how many there were."""
        found = 0
        for camera, handle in list(self.layers.frusta.items()):
            image = self.shown.image(camera)
            if image is not None:
                handle.image, found = image, found + 1
        return found

    def picture(self, camera: int) -> np.ndarray:
        """The picture of an image with its residuals, shape (height, width, 3)."""
        looks, planes = self.shown.looks, self.image_planes
        size = 2 * planes.half[camera] * planes.focal[camera]
        principal = size / 2
        if looks is not None and looks.sizes[camera].all():
            size, principal = looks.sizes[camera], looks.principal[camera]
        segments, _ = geometry.residual_segments(self.problem, planes, self.measures.residuals, camera)
        return picture_of(self.shown.image(camera), size, segments * planes.focal[camera] + principal)

    def limits_text(self) -> str:
        """What the colours of points mean."""
        if self.colour == FILE:
            return ""
        low, high = self._error_limits if self.colour == ERROR else self._track_limits
        unit = "px" if self.colour == ERROR else "views"
        return f"violet: {low:.3g} {unit} or less; yellow: {high:.3g} or more"

    def _set_limits(self) -> None:
        measures = self.measures
        self._error_limits, self._image_limits = limits(measures.of_point), limits(measures.of_image)
        self._track_limits = limits(measures.tracks.astype(float))

    def _draw(self) -> None:
        layers, problem, measures, similarity = self.layers, self.problem, self.measures, self._similarity
        points = similarity.points(np.asarray(problem.points)[self.points])
        poses = similarity.poses(camera_poses(problem.cameras))
        with self._server.atomic():
            layers.cloud("points", points, self._colours(measures)[self.points], POINT_SIZE)
            shown = set(self.frusta.tolist()) | ({self.chosen} if self.chosen is not None else set())
            of_image = colours(measures.of_image, *self._image_limits)
            for camera in sorted(shown):
                colour = CHOSEN if camera == self.chosen else tuple(of_image[camera].tolist())
                half = self.image_planes.half[camera]
                layers.frustum(camera, poses[camera], half, self._size, colour, self._on_click)
            for camera in layers.frusta.keys() - shown:
                layers.frusta.pop(camera).remove()
            self._mark(problem, measures, poses)
            for number, segments in enumerate(geometry.row_segments(problem)):
                ends = similarity.points(segments.reshape(-1, 3)).reshape(-1, 2, 3)
                layers.lines(f"rows {number}", ends, KINDS[number % len(KINDS)], 1.0)
            if "start points" not in layers and self.shown.recording.last > 0:
                self._draw_start()
            self._label(points)

    def _colours(self, measures: Measures) -> np.ndarray:
        if self.colour == FILE and self._file_colours is not None:
            return self._file_colours
        if self.colour == TRACK:
            return colours(measures.tracks.astype(float), *self._track_limits)
        return colours(measures.of_point, *self._error_limits)

    def _size_of_frusta(self, problem: BundleProblem) -> float:
        """Such that neighbours do not cover each other."""
        centers = self._similarity.points(camera_centers(problem.cameras)[self.frusta])
        if len(centers) < 2:
            return 0.15
        distance = np.linalg.norm(centers[:, None] - centers[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        return float(np.clip(0.5 * np.median(distance.min(axis=1)), 0.015, 0.15))

    def _on_page(self, poses: np.ndarray, plane: np.ndarray, depth: Any) -> np.ndarray:
        """Places on the page of places in the planes at distance 1 before cameras, at a depth."""
        local = np.concatenate([plane, np.ones((*plane.shape[:-1], 1))], axis=-1) * np.asarray(depth)[..., None]
        return np.einsum("...ij,...j->...i", poses[..., :3], local) + poses[..., 3]

    def _mark(self, problem: BundleProblem, measures: Measures, poses: np.ndarray) -> None:
        if self.chosen is None:
            self.layers.remove("chosen")
            return
        camera = self.chosen
        own = np.asarray(problem.point_index)[np.asarray(problem.camera_index) == camera]
        points = self._similarity.points(np.asarray(problem.points)[own])
        self.layers.cloud("chosen points", points, CHOSEN, 1.8 * POINT_SIZE)
        segments, _ = geometry.residual_segments(problem, self.image_planes, measures.residuals, camera)
        depth = geometry.depth_of_image(self.image_planes.half[camera : camera + 1], self._size)[0]
        self.layers.lines("chosen residuals", self._on_page(poses[camera], segments, depth), RESIDUAL, 2.0)

    def _draw_start(self) -> None:
        start = self.shown.problem
        poses = self._similarity.poses(camera_poses(start.cameras))[self.frusta]
        half = self.image_planes.half[self.frusta]
        depth = geometry.depth_of_image(half, self._size)
        corners = self._on_page(poses[:, None], _CORNERS * half[:, None], depth[:, None])  # of images, (n, 4, 3)
        apex = np.broadcast_to(poses[:, None, :, 3], corners.shape)
        around = np.stack([corners, np.roll(corners, -1, axis=1)], axis=2)
        spokes = np.stack([apex, corners], axis=2)
        points = self._similarity.points(np.asarray(start.points)[self.points])
        self.layers.cloud("start points", points, START, 0.6 * POINT_SIZE)
        self.layers.lines("start cameras", np.concatenate([around, spokes], axis=1).reshape(-1, 2, 3), START, 1.0)

    def _label(self, points: Float[np.ndarray, "n 3"]) -> None:
        if self._caption:
            words = [self.shown.name, *([self.numbers("\n")] if self._caption == "numbers" else [])]
            text = "\n".join(words)
            self.layers.label(text, (0.0, 0.0, float(np.percentile(points[:, 2], 95)) + 0.3))

    def numbers(self, between: str = ", ") -> str:
        """The iteration shown, in words: cost, lambda, gain, seconds; of a problem its error. `between` stands between
        the parts."""
        recording, k = self.shown.recording, self.iteration
        error = f"RMSE {self.measures.rmse:.4g} px"
        if recording.last == 0:
            return error
        if k == 0:
            return between.join(["start", f"cost {recording.cost[0]:.5g}", error])
        how = "" if recording.accepted[k] else ", rejected"
        cost = f"cost {recording.cost[k]:.5g}, {error}"
        took = f"{recording.time_s[k]:.3g} s"
        step = f"λ {recording.damping[k]:.2g}, gain {recording.gain_ratio[k]:.2g}, {took}"
        return between.join([f"iteration {k} of {recording.last}{how}", cost, step])
