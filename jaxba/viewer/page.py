"""The page: stages side by side, and a panel with a slider, numbers, colours, filters and the worst
images."""

from __future__ import annotations

import html
import io
import socket
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from jaxba.viewer import words
from jaxba.viewer.curve import add_curve, colour_of, curve_of
from jaxba.viewer.extra import HOST, quietly, viser
from jaxba.viewer.page_file import page_of, stages
from jaxba.viewer.recording import Recording
from jaxba.viewer.sources import Shown
from jaxba.viewer.stage import ERROR, POINT_SIZE, SHOWN_POINTS, Stage

NOTHING: str = "none: the whole scene"
FRAME_S = 0.5  # seconds for which an iteration is shown while the page plays
PICKED = 8  # pixels at most between a click and the point that it means
# how near something is drawn in the view of an image's camera, as a share of the way to the image
NEAR = 0.3


class Viewer:
    """A page that is served until it is closed."""

    def __init__(self, all_shown: Sequence[Shown], host: str = HOST) -> None:
        """Serves a page at port 8080 or the next free one of an address of this machine; `0.0.0.0`:
        of all of them."""
        self.host, self.server = (
            host,
            quietly(viser.ViserServer, host=host, label="jaxba", verbose=False),
        )
        self._lock = threading.RLock()
        self._playing = False
        # where the last click met an image, and where the chosen one was taken
        self._hit = self._inside = None
        self.stages = stages(self.server, all_shown, SHOWN_POINTS, self._clicked)
        self.server.scene.on_click()(self._pointed)
        self._panel()

    @property
    def url(self) -> str:
        """Address of the page."""
        host = socket.gethostname() if self.host in ("0.0.0.0", "::") else self.host
        return f"http://{f'[{host}]' if ':' in host else host}:{self.server.get_port()}"

    def close(self) -> None:
        """Ends the server."""
        self._playing = False
        quietly(self.server.stop)

    def load_images(self) -> int:
        """Puts images into frusta; returns how many are not at hand, of those that should be."""
        return sum(stage.load_images() for stage in self.stages)

    def _repr_html_(self) -> str:
        """A page in a file, inside of a notebook: it needs no server, so that a saved notebook
        shows it."""
        page = html.escape(page_of([stage.shown for stage in self.stages]))
        return f'<iframe srcdoc="{page}" width="100%" height="600" style="border:0"></iframe>'

    def choose(
        self, stage: Stage, camera: int | None, client: viser.ClientHandle | None = None
    ) -> None:
        """Marks an image, says how well it fits, and moves a client into its camera, or for None to
        the whole scene."""
        with self._lock:
            for one in self.stages:
                one.change(chosen=camera if one is stage else None, tracked=None)
            self._listed = {
                name: (one, k) for one in self.stages for name, k in words.worst_images(one)
            }
            name = NOTHING if camera is None else words.entry(stage, camera)
            self._listed |= {} if camera is None else {name: (stage, camera)}
            self._picked.options = (NOTHING, *self._listed)
            self._picked.value = name
            self._tell()
            if client is not None:
                self._move(client, stage, camera)

    def _move(self, client: viser.ClientHandle, stage: Stage, camera: int | None) -> None:
        start = self.server.initial_camera
        view = client.camera
        self._inside = None
        if camera is None:
            place = start.position
            target = start.look_at
            up = (0.0, 0.0, 1.0)
            fov = start.fov
            near = start.near
        else:
            pose, half, depth = stage.view_of(camera)
            place = pose[:, 3] + stage.place
            up = -pose[:, 1]
            near = NEAR * depth
            target = place + depth * pose[:, 2]
            fov = 2 * np.arctan(1.05 * max(half[1], half[0] / view.aspect))
            self._inside = place
        view.position = place
        view.look_at = target
        view.up_direction = up
        view.fov = float(fov)
        view.near = near

    def _clicked(self, place: int, camera: int, event: viser.SceneNodePointerEvent) -> None:
        if not self._is_inside(event.client):  # there a click is on a point
            self._hit = event.screen_pos
            self.choose(self.stages[place], camera, event.client)

    def _is_inside(self, client: viser.ClientHandle) -> bool:
        """Whether a client looks from the camera that is chosen."""
        return self._inside is not None and np.allclose(
            client.camera.position, self._inside, atol=1e-4
        )

    def _pointed(self, event: viser.SceneClickEvent) -> None:
        """A click on a point, or on nothing. That on an image comes here, too."""
        view = event.client.camera
        ray = (
            np.array(event.ray_origin),
            np.array(event.ray_direction),
            PICKED * view.fov / view.image_height,
        )
        if event.screen_pos != self._hit:
            with self._lock:
                for stage in self.stages:
                    stage.pick(*ray, self._is_inside(event.client))
                self._tell()

    def grow(self, recording: Recording) -> None:
        """Shows the last iteration of a solve that is running, unless another one is being looked
        at."""
        shown = self.stages[0].shown
        last = recording.last
        newest = self.stages[0].iteration == shown.recording.last
        self._change(shown=replace(shown, recording=recording))
        self._slider.max = max(last, 1)
        self._slider.visible = last > 0
        self._play.visible = last > 0
        if newest:
            self._slider.value = last

    def _panel(self) -> None:
        gui = self.server.gui
        last = max(stage.shown.recording.last for stage in self.stages)
        gui.main_panel.dock_right()

        def dress(dark):
            return gui.configure_theme(show_share_button=False, show_logo=False, dark_mode=dark)

        dress(False)
        lines = [
            f"**{words.plain(stage.shown.name)}**: {words.sizes(stage)}" for stage in self.stages
        ]
        if len(lines) > 1:
            lines = [
                f'<font color="{colour_of(k)}">●</font> {line}' for k, line in enumerate(lines)
            ]
        gui.add_markdown("\n\n".join(lines))
        self._slider = gui.add_slider("iteration", 0, max(last, 1), 1, last, visible=last > 0)
        self._play = gui.add_button("play or stop", visible=last > 0)
        self._numbers = gui.add_markdown("")
        self._curve = add_curve(self.server, self.stages)
        self._picked = gui.add_dropdown("worst images", (NOTHING,))
        self._about = gui.add_markdown("")
        if rows := [line for stage in self.stages for line in words.about_rows(stage)]:
            gui.add_markdown("\n\n".join(rows))
        choices = list(
            dict.fromkeys(name for stage in self.stages for name in stage.colour_choices())
        )
        colour = gui.add_dropdown("colour", choices, initial_value=self.stages[0].colour)
        ends = [
            (stage.limits[ERROR][1], stage.measures.tracks.max(initial=2).item())
            for stage in self.stages
        ]
        self._between("error, px", 0, 2 * max(error for error, _ in ends), "errors")
        self._between("track length", 1, max(length for _, length in ends), "lengths")
        points = gui.add_slider("size of points", 0.001, 0.03, 0.001, POINT_SIZE)
        frusta = gui.add_slider("size of frusta", 0.1, 5.0, 0.1, 1.0)
        named = gui.add_checkbox("names of images", False)
        dark = gui.add_checkbox("dark", False)
        self._slider.on_update(lambda _: self._change(iteration=int(self._slider.value)))
        self._play.on_click(lambda _: self._run())
        self._picked.on_update(self._listed_picked)
        colour.on_update(lambda _: self._change(colour=colour.value))
        points.on_update(lambda _: self._change(point_size=points.value))
        frusta.on_update(lambda _: self._change(enlarged=frusta.value))
        named.on_update(lambda _: self._change(named=named.value))
        dark.on_update(lambda _: dress(dark.value))
        gui.add_button("save a picture").on_click(self._save)
        self.choose(self.stages[0], None)

    def _between(self, label: str, low: int, high: Any, name: str) -> None:
        """A slider for the least and the largest value of the points that are shown; at its end it
        has no limit."""
        slider = self.server.gui.add_multi_slider(
            label, low, high, 1 if low else high / 200, (low, high)
        )

        def ends(least, most):
            return (least if least > low else 0.0, most if most < high else np.inf)

        slider.on_update(lambda _: self._change(**{name: ends(*slider.value)}))

    def _run(self) -> None:
        """Plays to the last iteration, from the start if it is shown; a second click ends it."""
        self._playing = not self._playing
        while self._playing:
            self._slider.value = (self._slider.value + 1) % (self._slider.max + 1)
            time.sleep(FRAME_S)
            self._playing &= self._slider.value < self._slider.max

    def _listed_picked(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # else it follows a click
            self.choose(*self._listed.get(self._picked.value, (self.stages[0], None)), event.client)

    def _save(self, event: viser.GuiEvent) -> None:
        """Downloads what a client sees as a picture."""
        from PIL import Image

        assert event.client is not None  # it has clicked
        view = event.client.camera
        file = io.BytesIO()
        Image.fromarray(event.client.get_render(view.image_height, view.image_width)).save(
            file, "PNG"
        )
        event.client.send_file_download("jaxba.png", file.getvalue(), save_immediately=True)

    def _change(self, **what: Any) -> None:
        with self._lock:
            for stage in self.stages:
                stage.change(**what)
            self._tell()

    def _tell(self) -> None:
        """Numbers of the iteration beside the slider, and of what was clicked."""
        lines = []
        for stage in self.stages:
            name = f"**{words.plain(stage.shown.name)}**: " if len(self.stages) > 1 else ""
            lines.append(f"{name}{words.numbers(stage)}  \n*{words.meaning(stage)}*")
        self._numbers.content = "\n\n".join(lines)
        self._curve.data, self._curve.scales = curve_of(self.stages)
        self._curve.visible = len(self._curve.data[0]) > 1
        about = [
            words.about_image(stage, stage.chosen)
            for stage in self.stages
            if stage.chosen is not None
        ]
        about += [
            words.about_track(stage, stage.tracked)
            for stage in self.stages
            if stage.tracked is not None
        ]
        self._about.content = (
            "\n\n".join(about) or "Click on an image or a point, or choose one of the worst images."
        )
