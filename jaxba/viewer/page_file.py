"""One page that needs no server: viser's own client and a recording of its scene, in one file."""

from __future__ import annotations

import html
from collections.abc import Sequence

from jaxba.io.files import StrPath, open_output
from jaxba.viewer.page import heading, stages, start_server, stop_server, worst_images
from jaxba.viewer.sources import Shown
from jaxba.viewer.stage import Stage

PAGE_POINTS = 50_000
"""Most points on a page in a file."""

FRAME_S = 1.0
"""Seconds for which an iteration is shown while the page plays."""

LISTED = 5
"""Worst images that the page names."""


def write_page(all_shown: Sequence[Shown], path: StrPath) -> None:
    """Writes a page that plays the iterations of all solves, in step; the worst image at the end is marked. Raises
    ProblemError: it cannot be written."""
    server = start_server()
    try:
        drawn = stages(server, all_shown, points=PAGE_POINTS, caption="numbers")
        for stage in drawn:
            stage.load_images()
            if len(worst := stage.measures.worst()):
                stage.choose(int(worst[0]))
        last = max(stage.shown.recording.last for stage in drawn)
        summary = _summary(drawn)
        for stage in drawn:
            stage.show(0)
        film = server.get_scene_serializer()
        for iteration in range(1, last + 1):
            film.insert_sleep(FRAME_S)
            for stage in drawn:
                stage.show(iteration)
        if last:
            film.insert_sleep(2 * FRAME_S)
        page = film.as_html()
    finally:
        stop_server(server)
    title = html.escape(", ".join(one.name for one in all_shown))
    page = page.replace("<title>Viser</title>", f"<title>jaxba: {title}</title>", 1)
    page = page.replace("</body>", f"{summary}</body>", 1)
    with open_output(path) as file:
        file.write(page.encode())


def _summary(drawn: Sequence[Stage]) -> str:
    """What the scene cannot say, in a corner of the page."""
    parts = []
    for stage in drawn:
        parts.append(f"<p>{html.escape(heading(stage))}; {html.escape(stage.numbers())}")
        if meaning := stage.limits_text():
            parts.append(f"<br>points: {html.escape(stage.colour)}, {html.escape(meaning)}")
        items = "".join(f"<li>{html.escape(text)}</li>" for text, _ in worst_images(stage, LISTED))
        parts.append(f"<br>worst images, and observations:<ol>{items}</ol></p>")
    style = (
        "position:fixed;left:8px;top:8px;max-width:24em;padding:4px 8px;font:12px sans-serif;background:#fffc;z-index:9"
    )
    return f'<details open style="{style}"><summary>jaxba</summary>{"".join(parts)}</details>'
