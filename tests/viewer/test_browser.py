"""The viewer's page and the one in a file, in headless Chromium: pixels, no error, no request
elsewhere.

Points and frusta of a problem without colours are viridis's, what is chosen is orange; software
rendering gives them to within a few shades."""

from __future__ import annotations

import io
import json
import shutil
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import jaxba

pytest.importorskip("viser", reason="needs the extra: pip install jaxba[view]")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")

CHROMIUM = shutil.which("chromium")
DRIVER = shutil.which("chromedriver")

pytestmark = [
    pytest.mark.extra,
    pytest.mark.skipif(
        not (CHROMIUM and DRIVER), reason="needs Debian's packages chromium and chromium-driver"
    ),
    pytest.mark.filterwarnings("default"),  # of viser and its server
]

FLAGS = (
    *(
        "--headless=new",
        "--no-sandbox",
        "--disable-quic",
        "--no-first-run",
        "--disable-background-networking",
    ),
    *(
        "--disable-component-update",
        "--disable-sync",
        "--use-angle=swiftshader",
        "--enable-unsafe-swiftshader",
    ),
    *("--window-size=900,700", "--disable-dev-shm-usage"),
    "--host-resolver-rules=MAP * ~NOTFOUND, EXCLUDE 127.0.0.1",
)

READY_S = 60.0
"""Software rendering on a busy machine takes a while."""

ORANGE = (255, 120, 0)


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    options = webdriver.ChromeOptions()
    options.binary_location = CHROMIUM
    for flag in (*FLAGS, f"--user-data-dir={tmp_path_factory.mktemp('chromium')}"):
        options.add_argument(flag)
    options.set_capability("goog:loggingPrefs", {"performance": "ALL", "browser": "ALL"})
    driver = webdriver.Chrome(options=options, service=webdriver.ChromeService(DRIVER))
    driver.set_script_timeout(READY_S)
    yield driver
    driver.quit()


@pytest.fixture(scope="module")
def recording():
    from jaxba.viewer.recording import Recorder

    problem = jaxba.random_scene(jaxba.SceneConfig(cameras=8, points=300, trajectory="orbit"), 0)
    recorder = Recorder(problem)
    jaxba.solve(problem, "ceres", jaxba.SolveOptions(max_iterations=5), watch=recorder)
    return recorder.recording()


@pytest.fixture
def viewer(recording, browser):
    from jaxba.viewer.page import Viewer
    from jaxba.viewer.sources import shown

    found = Viewer([shown(recording, "run")])
    for log in ("browser", "performance"):
        browser.get_log(log)  # what went before
    yield found
    browser.get("about:blank")
    found.close()


def picture(browser) -> np.ndarray:
    """Pixels of the page, shape (height, width, 3)."""
    from PIL import Image

    return np.asarray(
        Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB"), np.int16
    )


def scene(browser) -> np.ndarray:
    """Pixels of the scene, left of the panel."""
    return picture(browser)[:, :560]


def coloured(pixels: np.ndarray) -> int:
    """Number of pixels that are neither grey nor white: points and frusta, not background or
    text."""
    return int((pixels.max(axis=2) - pixels.min(axis=2) > 60).sum())


def like(pixels: np.ndarray, colour: tuple[int, int, int]) -> int:
    """Number of pixels of nearly a colour."""
    return int((np.abs(pixels - colour).max(axis=2) < 40).sum())


def wait_for(what, browser) -> None:
    end = time.monotonic() + READY_S
    while not what():
        if time.monotonic() > end:
            pytest.fail(f"the page did not get there; {coloured(scene(browser))} coloured pixels")
        time.sleep(0.3)


def settled(browser) -> np.ndarray:
    """The scene when it is drawn and stands still: four looks in a row are the same."""
    looks: list[np.ndarray] = []

    def is_still() -> bool:
        looks.append(scene(browser))
        return (
            coloured(looks[-1]) > 500
            and len(looks) > 3
            and all((look == looks[-1]).all() for look in looks[-4:])
        )

    wait_for(is_still, browser)
    return looks[-1]


def check_silent(browser, *allowed: str) -> None:
    """No error on the console, as of a name that does not resolve, and no request but to these
    origins."""
    errors = [line["message"] for line in browser.get_log("browser") if line["level"] == "SEVERE"]
    assert errors == []
    asked = []
    for line in browser.get_log("performance"):
        message = json.loads(line["message"])["message"]
        for key in ("request", "url"):
            found = message["params"].get(key)
            url = found.get("url") if isinstance(found, dict) else found
            if (
                message["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated")
                and url
            ):
                asked.append(url)
    assert asked
    assert [url for url in asked if not url.startswith((*allowed, "data:", "blob:"))] == []


def curve_pixels(browser) -> int:
    """Pixels of the chart of costs that have the colour of the curve."""
    from PIL import Image

    from jaxba.viewer.curve import colour_of

    chart = browser.find_element("css selector", ".uplot canvas")
    pixels = np.asarray(Image.open(io.BytesIO(chart.screenshot_as_png)).convert("RGB"), float)
    blue = [int(colour_of(0)[k : k + 2], 16) for k in (1, 3, 5)]
    return int((np.abs(pixels - blue).max(axis=2) < 40).sum())


def test_the_page_shows_points_and_frusta_and_the_slider_changes_them(browser, viewer):
    browser.get(viewer.url)
    last = settled(browser)
    from selenium.webdriver.common.by import By

    text = browser.find_element(By.TAG_NAME, "body").text
    assert "8 images, " in text
    assert f"iteration {viewer.stages[0].shown.recording.last} of" in text
    assert curve_pixels(browser) > 50
    slider = browser.find_element(By.CSS_SELECTOR, "[role=slider]")
    slider.send_keys("\ue012" * 10)  # arrow to the left
    wait_for(lambda: "start, cost" in browser.find_element(By.TAG_NAME, "body").text, browser)
    wait_for(lambda: (np.abs(scene(browser) - last).max(axis=2) > 60).sum() > 200, browser)
    recorded = viewer.stages[0].shown.recording.cost
    iterations, excess, shown = viewer._curve.data
    np.testing.assert_array_equal(iterations, np.arange(len(recorded)))
    np.testing.assert_allclose(10 ** excess[:-1], recorded[:-1] / recorded.min() - 1)
    assert excess[-1] == pytest.approx(excess[-2] - 1)  # a tenth of the least above stands for zero
    np.testing.assert_array_equal(shown, [excess[0], *[np.nan] * (len(recorded) - 1)])
    check_silent(browser, viewer.url, viewer.url.replace("http", "ws"))


def screen(viewer, place) -> tuple[int, int]:
    """The pixel of a place on the page in the view of the one who looks."""
    from scipy.spatial.transform import Rotation

    (client,) = viewer.server.get_clients().values()
    view = client.camera
    x, y, z = Rotation.from_quat(view.wxyz, scalar_first=True).inv().apply(place - view.position)
    focal = view.image_height / 2 / np.tan(view.fov / 2)
    return round(view.image_width / 2 + focal * x / z), round(view.image_height / 2 + focal * y / z)


def click(browser, at: tuple[int, int]) -> None:
    from selenium.webdriver.common.action_chains import ActionChains

    body = browser.find_element("tag name", "body")
    middle = body.size["width"] // 2, body.size["height"] // 2
    ActionChains(browser).move_to_element_with_offset(
        body, at[0] - middle[0], at[1] - middle[1]
    ).click().perform()


def test_clicks_move_into_a_camera_and_show_the_track_of_a_point(browser, viewer):
    browser.get(viewer.url)
    before = like(settled(browser), ORANGE)

    def text():
        return browser.find_element("tag name", "body").text

    (stage,) = viewer.stages
    (client,) = viewer.server.get_clients().values()
    start = client.camera.position
    for camera in stage.frusta.tolist():  # some are outside of the window, or behind another
        pose, _, depth = stage.view_of(camera)
        click(browser, screen(viewer, pose[:, 3] + 0.9 * depth * pose[:, 2]))
        time.sleep(1.0)
        if stage.chosen is not None:
            break
    assert stage.chosen is not None, "no frustum was hit"
    wait_for(lambda: "times as long as they are, in all images" in text(), browser)
    wait_for(lambda: like(scene(browser), ORANGE) > before + 100, browser)
    pose, half, _ = stage.view_of(stage.chosen)
    np.testing.assert_allclose(client.camera.position, pose[:, 3], atol=1e-6)
    assert np.tan(client.camera.fov / 2) >= half[1]
    assert viewer._listed[viewer._picked.value] == (stage, stage.chosen)
    assert viewer._picked.value in browser.page_source

    viewer.choose(stage, None, client)
    np.testing.assert_allclose(client.camera.position, start, atol=1e-6)
    settled(browser)
    point = int(np.argmax(stage.measures.tracks))
    place = stage._similarity.points(np.asarray(stage.problem.points))[point]
    stage.change(enlarged=0.1)  # so that no frustum is before it
    settled(browser)
    click(browser, screen(viewer, place))
    wait_for(lambda: "the worst:" in text(), browser)
    assert stage.tracked is not None
    lines = stage.layers._nodes["track lines"].points
    assert len(lines) == stage.measures.tracks[stage.tracked]
    check_silent(browser, viewer.url, viewer.url.replace("http", "ws"))


def test_points_are_left_out_by_error_and_track_length(viewer):
    (stage,) = viewer.stages
    measures = stage.measures
    limit = float(np.median(stage.measures.of_point))
    stage.change(errors=(limit, np.inf), lengths=(3, 5))
    expected = np.flatnonzero(
        (measures.of_point >= limit) & (measures.tracks >= 3) & (measures.tracks <= 5)
    )
    np.testing.assert_array_equal(stage.kept(), expected)
    assert len(stage.layers._nodes["points"].points) == len(expected)


def test_play_goes_through_the_iterations_and_a_picture_is_saved(browser, viewer, monkeypatch):
    import viser

    from jaxba.viewer import page

    monkeypatch.setattr(page, "FRAME_S", 0.0)
    viewer._run()
    last = viewer.stages[0].shown.recording.last
    assert (viewer._slider.value, viewer.stages[0].iteration, viewer._playing) == (
        last,
        last,
        False,
    )
    browser.get(viewer.url)
    settled(browser)
    (client,) = viewer.server.get_clients().values()
    sent = {}
    monkeypatch.setattr(
        client, "send_file_download", lambda name, data, **_: sent.update({name: data})
    )
    viewer._save(viser.GuiEvent(client=client, client_id=client.client_id, target=viewer._play))
    from PIL import Image

    assert coloured(np.asarray(Image.open(io.BytesIO(sent["jaxba.png"])), np.int16)) > 500


def test_a_notebook_holds_a_page_without_a_server(browser, viewer, tmp_path):
    page = viewer._repr_html_()
    viewer.server.stop()
    path = tmp_path / "notebook.html"
    path.write_text(page)
    browser.get(f"file://{path}")
    wait_for(lambda: coloured(scene(browser)) > 500, browser)


def test_a_page_in_a_file_plays_without_a_server(browser, recording, tmp_path):
    from jaxba.viewer.page_file import write_page
    from jaxba.viewer.sources import shown

    path = tmp_path / "run.html"
    write_page([shown(recording, "run")], path)
    assert path.stat().st_size < 2e6
    for log in ("browser", "performance"):
        browser.get_log(log)
    browser.get(f"file://{path}")
    wait_for(lambda: coloured(scene(browser)) > 500, browser)
    first = scene(browser)
    wait_for(lambda: (np.abs(scene(browser) - first).max(axis=2) > 60).sum() > 200, browser)

    def text():
        return browser.find_element("tag name", "body").text

    assert "worst images" in text()
    wait_for(lambda: f"iteration {recording.last} of {recording.last}, cost" in text(), browser)
    wait_for(lambda: "start, cost" in text(), browser)
    check_silent(browser, "file://")


def test_a_solve_is_watched_while_it_runs(browser, viewer, recording):
    from dataclasses import replace

    browser.get(viewer.url)
    count = recording.last + 1
    wait_for(
        lambda: f"iteration {recording.last} of" in browser.find_element("tag name", "body").text,
        browser,
    )
    rows = ("state", "cost", "damping", "gain_ratio", "time_s")
    longer = {
        name: np.append(getattr(recording, name), getattr(recording, name)[-1]) for name in rows
    }
    threading.Thread(target=viewer.grow, args=(replace(recording, **longer),)).start()
    wait_for(
        lambda: f"iteration {count} of {count}" in browser.find_element("tag name", "body").text,
        browser,
    )


def test_slider_and_curve_come_with_the_first_iteration(recording):
    from dataclasses import replace

    from jaxba.viewer.page import Viewer
    from jaxba.viewer.sources import shown

    rows = ("state", "cost", "damping", "gain_ratio", "time_s")
    start = replace(recording, **{name: getattr(recording, name)[:1] for name in rows})
    viewer = Viewer([shown(start, "run")])
    try:
        assert not viewer._slider.visible
        assert not viewer._curve.visible
        viewer.grow(recording)
        assert viewer._slider.visible
        assert viewer._curve.visible
        assert viewer._slider.value == recording.last
    finally:
        viewer.close()


def test_residuals_are_segments_of_a_colour_for_each_and_their_worst_rows_are_listed(recording):
    from jaxba import residuals
    from jaxba.model.registration import costs_of_rows
    from jaxba.viewer.page import Viewer
    from jaxba.viewer.sources import shown
    from jaxba.viewer.words import about_rows

    problem = recording.problem
    bars = residuals.distance(
        point=[0, 1, 2], point_2=[3, 4, 5], length=[1e-3, 50.0, 1e-3], sigma=0.1
    )
    problem = jaxba.with_residual(problem, bars)
    ahead = residuals.baseline(pose=[0, 1], pose_2=[1, 2], length=1.0, sigma=0.1)
    problem = jaxba.with_residual(problem, ahead)
    viewer = Viewer([shown(problem, "run")])
    try:
        (stage,) = viewer.stages
        drawn = [stage.layers._nodes[f"rows {number}"].points for number in range(2)]
        assert [len(segments) for segments in drawn] == [3, 2]
        ends = stage._similarity.points(np.asarray(problem.points))[[1, 4]]
        np.testing.assert_allclose(drawn[0][1], ends, atol=1e-5)
        first, second = about_rows(stage)
        assert (
            f"distance**: cost {costs_of_rows(problem)[0].sum():.5g} of 3 rows; the worst: 1 ("
            in first
        )
        assert "rgb(0, 158, 115)" in second
    finally:
        viewer.close()


def test_the_command_says_what_is_missing(tmp_path, capsys):
    from jaxba.cli.view import run

    assert run([str(Path(tmp_path) / "no.npz")]) == 2
    assert "cannot read" in capsys.readouterr().err


def test_names_are_characters_and_nothing_else():
    from jaxba.viewer.words import plain

    assert plain("<b>*a*_1") == r"&lt;b&gt;\*a\*\_1"
