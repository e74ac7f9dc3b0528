"""The page: stages side by side, and a panel with a slider, numbers, colours and the worst images."""

from __future__ import annotations

import html
import re
import socket
import threading
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout
from dataclasses import replace
from io import StringIO

import numpy as np

from jaxba.model.registration import costs_of_rows
from jaxba.viewer import geometry
from jaxba.viewer.curve import add_curve, colour_of, curve_of
from jaxba.viewer.extra import viser
from jaxba.viewer.recording import Recording
from jaxba.viewer.sources import Shown
from jaxba.viewer.stage import ASIDE, KINDS, POINT_SIZE, SHOWN_POINTS, Stage

PORT = 8080
"""First port that is tried."""

BESIDE = 0.2
"""How far, as a share of the distance, the scene stands beside the middle: the panel is on the right, what a page in a
file says on the left."""

WORST, WORST_ROWS = 20, 5
"""Images in the list of the worst, and rows of a residual."""

NOTHING = "none"


HOST = "127.0.0.1"
"""Address under which only this machine reaches the page."""


def start_server(port: int = PORT, host: str = HOST) -> viser.ViserServer:
    """A server at this port or the next free one of an address of this machine."""
    with redirect_stdout(StringIO()):  # it prints a box with its address
        return viser.ViserServer(host=host, port=port, label="jaxba", verbose=False)


def stop_server(server: viser.ViserServer) -> None:
    """Ends a server without a word."""
    with redirect_stdout(StringIO()):
        server.stop()


class Viewer:
    """A page that is served until it is closed."""

    def __init__(self, all_shown: Sequence[Shown], port: int = PORT, host: str = HOST) -> None:
        """Serves a page at this port or the next free one of an address of this machine; `0.0.0.0`: of all of them."""
        self.host, self.server = host, start_server(port, host)
        self._lock = threading.RLock()
        self.stages = stages(self.server, all_shown, self.choose, caption="name" if len(all_shown) > 1 else "")
        self._panel()

    @property
    def url(self) -> str:
        """Address of the page."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def close(self) -> None:
        """Ends the server."""
        stop_server(self.server)

    def load_images(self) -> int:
        """Puts images into frusta; returns how many are not at hand, of those that should be."""
        wanted = [stage for stage in self.stages if stage.shown.images is not None]
        return sum(len(stage.frusta) - stage.load_images() for stage in wanted)

    def _repr_html_(self) -> str:
        """The page inside of a notebook."""
        return f'<iframe src="{self.url}" width="100%" height="600" style="border:0"></iframe>'

    def choose(self, stage: Stage, camera: int | None) -> None:
        """Marks an image, and says beside it how well it fits."""
        with self._lock:
            for one in self.stages:
                one.choose(camera if one is stage else None)
            if camera is None:
                self._about.content, self._picture.visible = "", False
            else:
                self._describe(stage, camera)

    def _describe(self, stage: Stage, camera: int) -> None:
        """Words and a picture of a chosen image."""
        self._about.content = about_image(stage, camera)
        self._picture.image = stage.picture(camera)
        self._picture.visible = True

    def grow(self, recording: Recording) -> None:
        """Shows the last iteration of a solve that is running, unless another one is being looked at."""
        with self._lock:
            stage = self.stages[0]
            newest = stage.iteration == stage.shown.recording.last
            stage.show(recording.last if newest else None, shown=replace(stage.shown, recording=recording))
            self._slider.max, self._slider.visible = max(recording.last, 1), recording.last > 0
            if newest:
                self._slider.value = recording.last
            self._tell()

    def _panel(self) -> None:
        gui, last = self.server.gui, max(stage.shown.recording.last for stage in self.stages)
        gui.configure_theme(show_share_button=False, show_logo=False)
        lines = [f"**{plain(stage.shown.name)}**: {sizes(stage)}" for stage in self.stages]
        if len(lines) > 1:
            lines = [f'<font color="{colour_of(k)}">●</font> {line}' for k, line in enumerate(lines)]
        gui.add_markdown("\n\n".join(lines))
        self._slider = gui.add_slider("iteration", 0, max(last, 1), 1, last, visible=last > 0)
        self._numbers = gui.add_markdown("")
        self._curve = add_curve(self.server, self.stages)
        choices = list(dict.fromkeys(name for stage in self.stages for name in stage.colour_choices()))
        colour = gui.add_dropdown("colour", choices, initial_value=self.stages[0].colour)
        size = gui.add_slider("size of points", 0.001, 0.03, 0.001, POINT_SIZE)
        worst = {name: (stage, camera) for stage in self.stages for name, camera in worst_images(stage)}
        picked = gui.add_dropdown("worst images", (NOTHING, *worst))
        self._about = gui.add_markdown("Click on an image, or choose one of the worst.")
        if rows := [line for stage in self.stages for line in about_rows(stage)]:
            gui.add_markdown("\n\n".join(rows))
        self._picture = gui.add_image(np.full((1, 1, 3), 255, np.uint8), visible=False)
        self._slider.on_update(lambda _: self._show(iteration=int(self._slider.value)))
        colour.on_update(lambda _: self._show(colour=colour.value))
        picked.on_update(lambda _: self.choose(*worst.get(picked.value, (self.stages[0], None))))
        size.on_update(lambda _: self._each(lambda stage: stage.layers.size("points", size.value)))
        if any("start points" in stage.layers for stage in self.stages):
            start = gui.add_checkbox("start, grey", True)
            start.on_update(lambda _: self._each(lambda stage: stage.layers.show("start", start.value)))
        self._tell()

    def _each(self, change: Callable[[Stage], None]) -> None:
        with self._lock:
            for stage in self.stages:
                change(stage)

    def _show(self, iteration: int | None = None, colour: str | None = None) -> None:
        with self._lock:
            for stage in self.stages:
                if iteration != stage.iteration:  # a slider that is drawn calls more often than it changes
                    stage.show(iteration, colour)
                if stage.chosen is not None:
                    self._describe(stage, stage.chosen)
            self._tell()

    def _tell(self) -> None:
        """Numbers of the iteration beside the slider."""
        lines = []
        for stage in self.stages:
            name = f"**{plain(stage.shown.name)}**: " if len(self.stages) > 1 else ""
            meaning = stage.limits_text()
            lines.append(f"{name}{stage.numbers()}" + (f"  \n*{meaning}*" if meaning else ""))
        self._numbers.content = "\n\n".join(lines)
        self._curve.data = data = curve_of(self.stages)
        self._curve.visible = len(data[0]) > 1


def stages(
    server: viser.ViserServer,
    all_shown: Sequence[Shown],
    on_click: Callable[[Stage, int], None] | None = None,
    points: int = SHOWN_POINTS,
    caption: str = "",
) -> list[Stage]:
    """Draws problems and solves side by side, with at most so many points together, and turns the camera to them. A
    click on an image calls `on_click` with its stage and its number; `caption` is that of a `Stage`."""
    share = max(points // len(all_shown), 1)
    found: list[Stage] = []
    for place, one in enumerate(all_shown):
        click = None if on_click is None else lambda camera, place=place: on_click(found[place], camera)
        found.append(Stage(server, one, f"{place + 1}", place, share, click, caption))
    middle = ASIDE * (len(all_shown) - 1) / 2
    away = 2.2 + 1.2 * middle
    across = middle + BESIDE * (away if on_click else -away)
    server.initial_camera.position = (across, -away, 0.7 * away)
    server.initial_camera.look_at = (across, 0.0, 0.0)
    return found


def plain(name: str) -> str:
    """A name as Markdown that means just its characters: viser renders HTML and Markdown as they come."""
    return re.sub(r"([\\`*_{}\[\]()#+.!|~>-])", r"\\\1", html.escape(name)) if name else name


def heading(stage: Stage) -> str:
    """The name of what is shown, its sizes, and how much of it; plain text."""
    return f"{stage.shown.name}: {sizes(stage)}"


def sizes(stage: Stage) -> str:
    """Sizes of what is shown, and how much of it."""
    recording, problem = stage.shown.recording, stage.shown.problem
    points, cameras = len(stage.points), len(stage.frusta)
    of_points = f"{points:,} of {recording.whole:,} points" if points < recording.whole else f"{points:,} points"
    of_cameras = f"{cameras:,} of {problem.num_cameras:,}" if cameras < problem.num_cameras else f"{cameras:,}"
    thinned = recording.whole > problem.num_points
    of = " of these points" if thinned else ""
    return f"{of_cameras} images, {of_points}, {problem.num_observations:,} observations{of}"


def worst_images(stage: Stage, count: int = WORST) -> list[tuple[str, int]]:
    """The worst images: a line of text for each, and its number."""
    measures = stage.measures
    return [
        (f"{measures.of_image[camera]:.3g} px: {stage.shown.name_of(camera)} ({measures.seen[camera]:,})", camera)
        for camera in measures.worst()[:count].tolist()
    ]


def about_rows(stage: Stage) -> list[str]:
    """For each residual besides those of pixels its colour, its cost and its worst rows, at the iteration shown."""
    rows, lines = stage.problem.residuals.rows, []
    for number, costs in enumerate(costs_of_rows(stage.problem) if rows else ()):
        worst = ", ".join(f"{row} ({costs[row]:.3g})" for row in np.argsort(-costs, kind="stable")[:WORST_ROWS])
        colour, name = KINDS[number % len(KINDS)], plain(rows[number].residual.name)
        cost = f"cost {costs.sum():.5g} of {len(costs):,} rows; the worst: {worst}"
        lines.append(f'<font color="rgb{colour}">●</font> **{name}**: {cost}')
    return lines


def about_image(stage: Stage, camera: int) -> str:
    """How well an image fits."""
    measures = stage.measures
    rank = np.flatnonzero(measures.worst() == camera)
    of = f", rank {rank[0] + 1} of {len(measures.worst())} from the worst" if len(rank) else ""
    _, factor = geometry.residual_segments(stage.problem, stage.image_planes, measures.residuals, camera)
    return (
        f"**{plain(stage.shown.name_of(camera))}**: {measures.seen[camera]:,} observations, "
        f"RMSE {measures.of_image[camera]:.3g} px{of}. Residuals are drawn {factor:.3g} times as long as they are, "
        "from the measured pixel to the predicted one."
    )
