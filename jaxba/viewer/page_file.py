"""One page that needs no server: viser's own client and a recording of its scene, in one file."""

from __future__ import annotations

import html
import json
from collections.abc import Sequence
from functools import partial
from typing import Any

from jaxba.io.files import StrPath, open_output
from jaxba.viewer.extra import HOST, quietly, viser
from jaxba.viewer.sources import Shown
from jaxba.viewer.stage import ASIDE, Stage
from jaxba.viewer.words import meaning, numbers, sizes, worst_images

PAGE_POINTS, LISTED = 50_000, 5  # most points on a page in a file, and worst images that it names
# seconds for which an iteration is shown; shift of the view to the left, where the words are
FRAME_S = 1.0
LEFT = 0.4

WORDS = """<details open style="position:fixed;left:8px;top:8px;max-width:24em;padding:4px 8px;
font:12px sans-serif;color-scheme:light dark;background:Canvas;color:CanvasText;opacity:.85;
z-index:9"><summary>jaxba</summary>%s</details>
<script>setInterval(() => {
    const time = Number(document.querySelector("[role=slider]")?.ariaValueNow ?? 0);
    document.querySelectorAll("[data-numbers]").forEach(place => {
        const numbers = JSON.parse(place.dataset.numbers);
        place.textContent = numbers[Math.min(Math.floor(time / %g + 1e-6), numbers.length - 1)];
    });
}, 100)</script></body>"""
"""What the scene cannot say, in a corner of the page: numbers of the iteration that its slider
shows, and more."""


def page_of(all_shown: Sequence[Shown]) -> str:
    """A page that plays the iterations of all solves, in step; the worst image at the end is
    marked."""
    server = quietly(viser.ViserServer, host=HOST, verbose=False)
    words = []
    try:
        drawn = stages(server, all_shown, PAGE_POINTS)
        server.initial_camera.position -= (LEFT, 0, 0)
        server.initial_camera.look_at -= (LEFT, 0, 0)
        last = max(one.recording.last for one in all_shown)
        told: list[list[str]] = [[] for _ in drawn]
        for stage in drawn:
            stage.load_images()
            worst = worst_images(stage, LISTED)
            stage.change(chosen=worst[0][1] if worst else None)
            items = "".join(f"<li>{html.escape(text)}</li>" for text, _ in worst)
            what = html.escape(f"{stage.shown.name}: {sizes(stage)}")
            words.append(
                f"{what}<br>{meaning(stage)}<br>worst images, and observations:<ol>{items}</ol>"
            )
            stage.change(iteration=0)
        film = server.get_scene_serializer()
        for iteration in range(last + 1):
            for stage, its in zip(drawn, told, strict=True):
                if iteration:
                    stage.change(iteration=iteration)
                its.append(numbers(stage))
            film.insert_sleep(FRAME_S if last else 0.0)
        page = film.as_html().replace(
            "darkMode:false", "darkMode:matchMedia('(prefers-color-scheme:dark)').matches", 1
        )
    finally:
        quietly(server.stop)
    words += [f'<p><b data-numbers="{html.escape(json.dumps(its))}"></b></p>' for its in told]
    title = html.escape(", ".join(one.name for one in all_shown))
    page = page.replace("<title>Viser</title>", f"<title>jaxba: {title}</title>", 1)
    return page.replace("</body>", WORDS % ("".join(words), FRAME_S), 1)


def stages(
    server: viser.ViserServer, all_shown: Sequence[Shown], points: int, clicked: Any = None
) -> list[Stage]:
    """Draws problems and solves side by side, with at most so many points together, and turns the
    camera to them. A click on an image calls `clicked` with the numbers of its stage and itself,
    and the event."""
    share = max(points // len(all_shown), 1)
    found = []
    for place, one in enumerate(all_shown):
        click = None if clicked is None else partial(clicked, place)
        found.append(Stage(server, one, place, share, click, len(all_shown) > 1))
    middle = ASIDE * (len(all_shown) - 1) / 2
    away = 2.2 + 1.2 * middle
    server.initial_camera.position = (middle, -away, 0.7 * away)
    server.initial_camera.look_at = (middle, 0.0, 0.0)
    return found


def write_page(all_shown: Sequence[Shown], path: StrPath) -> None:
    """Writes a page to a file. Raises ProblemError: it cannot be written."""
    page = page_of(all_shown)
    with open_output(path) as file:
        file.write(page.encode())
