"""One problem or recorded solve drawn into a scene of viser, moved and scaled so that several stand
side by side."""

from __future__ import annotations

from typing import Any

import numpy as np

from jaxba.problem.bundle_problem import BundleProblem
from jaxba.problem.geometry import camera_centers, camera_poses
from jaxba.problem.similarity import upright
from jaxba.viewer import geometry
from jaxba.viewer.extra import viser
from jaxba.viewer.layers import Clicked, Layers
from jaxba.viewer.measures import Measures, colours, limits, measure
from jaxba.viewer.recording import evenly
from jaxba.viewer.sources import Shown

# most on a page; software rendering draws them at a few frames a second
SHOWN_POINTS = 200_000
SHOWN_FRUSTA = 500
POINT_SIZE = 0.006  # of points; scenes have a size of about one
# distance between neighbouring stages, and where the name of one of several is
ASIDE = 3.0
ABOVE = (0.0, 0.0, 1.3)
FILE = "colour of the file"
ERROR = "reprojection error"
TRACK = "track length"
IMAGE = "error of images"
CHOSEN, RESIDUAL = (255, 120, 0), (208, 0, 0)  # colours of what is chosen, and of its residuals
CHOSEN_SIDE = 1600  # pixels of the longer side of the chosen image
# colours of residuals besides those of pixels. Source: Okabe and Ito 2008, "Color Universal Design"
KINDS = ((0, 114, 178), (0, 158, 115), (204, 121, 167), (230, 159, 0), (86, 180, 233), (213, 94, 0))
# shares: depth of residuals in their image's, median length in its width
BEFORE = 0.99
TYPICAL = 0.015


class Stage:
    """What a page shows of one problem or solve; `change` changes it."""

    def __init__(
        self,
        server: viser.ViserServer,
        shown: Shown,
        place: int,
        points: int,
        clicked: Clicked,
        captioned: bool,
    ) -> None:
        """Draws the last iteration, with at most so many points. `place` counts those side by
        side."""
        self.shown = shown
        self._server = server
        self._clicked = clicked
        self.iteration = shown.recording.last
        self.point_size = POINT_SIZE
        self.enlarged = 1.0
        self.chosen: int | None = None
        self.tracked: int | None = None
        self.errors, self.lengths, self.named = (0.0, np.inf), (0.0, np.inf), False
        self.place = np.array([ASIDE * place, 0.0, 0.0])
        self.points = evenly(shown.problem.num_points, points)
        self.frusta = evenly(shown.problem.num_cameras, SHOWN_FRUSTA)
        last = self.problem
        looks = shown.looks
        sizes = None
        if looks is not None:  # with margins that put principal points in the middle
            sizes = np.where(
                looks.sizes > 0, 2 * np.maximum(looks.principal, looks.sizes - looks.principal), 0.0
            )
        self._file_colours = None if looks is None else looks.colours
        self.colour = self.colour_choices()[0]
        self._similarity = upright(last)
        self._measured = (-1, measure(last))
        self.image_planes = geometry.frusta_of(last, sizes)
        self._size = self._size_of_frusta(last)
        self.layers = Layers(server, f"/{place + 1}", tuple(self.place))
        if captioned:
            self.layers.label("caption", shown.name, ABOVE)
        self.change(shown=shown)

    def colour_choices(self) -> list[str]:
        """What colours of points may mean here; the first is shown at the beginning."""
        return [*([FILE] if self._file_colours is not None else []), ERROR, TRACK]

    @property
    def problem(self) -> BundleProblem:
        """The problem at the iteration shown."""
        return self.shown.recording.at(self.iteration)

    @property
    def measures(self) -> Measures:
        """Those of the iteration shown."""
        state = int(self.shown.recording.state[self.iteration])
        if self._measured[0] != state:
            self._measured = state, measure(self.problem)
        return self._measured[1]

    def change(self, **what: Any) -> None:
        """Changes what is shown: the `iteration`; the `colour` and `point_size` of points, by how
        much frusta are `enlarged`; the least and largest `errors` and `lengths` of tracks of
        points; the image that is `chosen`; the point that is `tracked`; whether images are `named`;
        or `shown`, for a recording that has grown."""
        for name, value in what.items():
            setattr(self, name, value)
        self.iteration = min(self.iteration, self.shown.recording.last)
        if "shown" in what:
            self.limits = {name: limits(values) for name, values in self._values().items()}
        self._draw()
        if "named" in what:
            self.layers.remove("name")
            for camera in self.frusta.tolist() if self.named else ():
                self.layers.label(
                    f"name {camera}",
                    self.shown.name_of(camera),
                    (0.0, 0.0, 0.0),
                    f"cameras/{camera}/",
                )
        if (camera := what.get("chosen")) is not None and (
            image := self.shown.image(camera, CHOSEN_SIDE)
        ) is not None:
            self.layers.frusta[camera].image = image

    def pick(self, origin: np.ndarray, ray: np.ndarray, angle: float, chosen: bool) -> None:
        """Marks the point that a ray meets: one that the chosen image sees, or any."""
        kept = np.intersect1d(self.kept(), self._seen()) if chosen else self.kept()
        points = self._similarity.points(np.asarray(self.problem.points)[kept])
        away = points + self.place - origin
        cosine = np.nan_to_num(
            away @ (ray / np.linalg.norm(ray)) / np.linalg.norm(away, axis=1), nan=-1.0
        )
        hit = len(kept) > 0 and cosine.max() > np.cos(angle)
        self.change(tracked=int(kept[cosine.argmax()]) if hit else None)

    def kept(self) -> np.ndarray:
        """The points that are drawn: those between the limits of reprojection errors and track
        lengths."""

        # NaN is within
        def within(values, limits):
            return ~((values < limits[0]) | (values > limits[1]))

        keep = within(self.measures.of_point, self.errors) & within(
            self.measures.tracks, self.lengths
        )
        return self.points[keep[self.points]]

    def _seen(self) -> np.ndarray:
        return np.asarray(self.problem.point_index)[
            np.asarray(self.problem.camera_index) == self.chosen
        ]

    def view_of(self, camera: int) -> tuple[np.ndarray, np.ndarray, float]:
        """An image's camera-to-world pose in the stage, half its size at distance 1, and how far
        off it is drawn."""
        half = self.image_planes.half[camera]
        pose = self._similarity.poses(camera_poses(self.problem.cameras)[[camera]])[0]
        return pose, half, geometry.depth_of_image(half, self.enlarged * self._size)

    @property
    def magnified(self) -> float:
        """How many times as long as they are residuals are drawn, in all images."""
        length = np.linalg.norm(self.measures.residuals, axis=1)
        typical = (
            float(np.median(length[np.isfinite(length)])) if np.isfinite(length).any() else 0.0
        )
        width = float(np.median(2 * self.image_planes.half[:, 0] * self.image_planes.focal[:, 0]))
        return max(1.0, TYPICAL * width / typical) if typical > 0 else 1.0

    def load_images(self) -> int:
        """Puts images into the frusta, and returns how many are not at hand."""
        missing = 0
        for camera, handle in self.layers.frusta.items() if self.shown.images is not None else ():
            handle.image = image = self.shown.image(camera)
            missing += image is None
        return missing

    def _draw(self) -> None:
        layers = self.layers
        problem = self.problem
        measures = self.measures
        similarity = self._similarity
        points = similarity.points(np.asarray(problem.points))
        poses = similarity.poses(camera_poses(problem.cameras))
        with self._server.atomic():
            kept = self.kept()
            name = TRACK if self.colour == TRACK else ERROR
            of_points = colours(self._values()[name], *self.limits[name])
            if self.colour == FILE and self._file_colours is not None:
                of_points = self._file_colours
            layers.cloud("points", points[kept], of_points[kept], self.point_size)
            shown = set(self.frusta.tolist()) | (
                {self.chosen} if self.chosen is not None else set()
            )
            of_image = colours(measures.of_image, *self.limits[IMAGE])
            for camera in sorted(shown):
                colour = CHOSEN if camera == self.chosen else tuple(of_image[camera].tolist())
                half = self.image_planes.half[camera]
                layers.frustum(
                    camera, poses[camera], half, self.enlarged * self._size, colour, self._clicked
                )
            for camera in layers.frusta.keys() - shown:
                layers.frusta.pop(camera).remove()
            layers.remove("chosen")
            layers.remove("track")
            if self.chosen is not None:
                layers.cloud("chosen points", points[self._seen()], CHOSEN, 1.8 * self.point_size)
                layers.lines("chosen residuals", self._residuals(self.chosen), RESIDUAL, 2.0)
            if self.tracked is not None:
                rows = np.flatnonzero(np.asarray(problem.point_index) == self.tracked)
                centers = poses[np.asarray(problem.camera_index)[rows], :, 3]
                ends = np.stack(
                    [np.broadcast_to(points[self.tracked], centers.shape), centers], axis=1
                )
                errors = colours(
                    np.linalg.norm(measures.residuals[rows], axis=1), *self.limits[ERROR]
                )
                layers.cloud("track point", points[[self.tracked]], CHOSEN, 3 * self.point_size)
                layers.lines("track lines", ends, np.stack([errors, errors], axis=1), 2.0)
            for number, segments in enumerate(geometry.row_segments(problem)):
                ends = similarity.points(segments.reshape(-1, 3)).reshape(-1, 2, 3)
                layers.lines(f"rows {number}", ends, KINDS[number % len(KINDS)], 1.0)

    def _values(self) -> dict[str, np.ndarray]:
        found = self.measures
        return {ERROR: found.of_point, TRACK: found.tracks.astype(float), IMAGE: found.of_image}

    def _size_of_frusta(self, problem: BundleProblem) -> float:
        """Such that neighbours do not cover each other."""
        centers = self._similarity.points(camera_centers(problem.cameras)[self.frusta])
        if len(centers) < 2:
            return 0.15
        distance = np.linalg.norm(centers[:, None] - centers[None], axis=2)
        np.fill_diagonal(distance, np.inf)
        return float(np.clip(0.5 * np.median(distance.min(axis=1)), 0.015, 0.15))

    def _residuals(self, camera: int) -> np.ndarray:
        """Residuals of an image as segments on the page, just before it."""
        pose, _, depth = self.view_of(camera)
        planes = self.image_planes
        residuals = self.measures.residuals
        segments = geometry.residual_segments(
            self.problem, planes, residuals, camera, self.magnified
        )
        local = np.concatenate([segments, np.ones((*segments.shape[:2], 1))], axis=2)
        return BEFORE * depth * local @ pose[:, :3].T + pose[:, 3]
