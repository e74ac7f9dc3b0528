"""The viewer's page and the one in a file, in headless Chromium: pixels, no error, no request elsewhere.

Points and frusta of a problem without colours are viridis's, what is chosen is orange; software rendering gives them to
within a few shades.
"""

from __future__ import annotations

import io
import json
import shutil
import socket
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import jaxba

pytest.importorskip("viser", reason="needs the extra: pip install jaxba[view]")
webdriver = pytest.importorskip("selenium.webdriver", reason="selenium is not installed")

CHROMIUM, DRIVER = shutil.which("chromium"), shutil.which("chromedriver")

pytestmark = [
    pytest.mark.extra,
    pytest.mark.skipif(not (CHROMIUM and DRIVER), reason="needs Debian's packages chromium and chromium-driver"),
    pytest.mark.filterwarnings("default"),  # of viser and its server
]

FLAGS = (
    *("--headless=new", "--no-sandbox", "--disable-quic", "--no-first-run", "--disable-background-networking"),
    *("--disable-component-update", "--disable-sync", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"),
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

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    found = Viewer([shown(recording, "run")], port)
    for log in ("browser", "performance"):
        browser.get_log(log)  # what went before
    yield found
    browser.get("about:blank")
    found.close()


def picture(browser) -> np.ndarray:
    """Pixels of the page, shape (height, width, 3)."""
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(browser.get_screenshot_as_png())).convert("RGB"), np.int16)


def scene(browser) -> np.ndarray:
    """Pixels of the scene, left of the panel."""
    return picture(browser)[:, :560]


def coloured(pixels: np.ndarray) -> int:
    """Number of pixels that are neither grey nor white: points and frusta, not background or text."""
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
        return coloured(looks[-1]) > 500 and len(looks) > 3 and all((look == looks[-1]).all() for look in looks[-4:])

    wait_for(is_still, browser)
    return looks[-1]


def check_silent(browser, *allowed: str) -> None:
    """No error on the console, as of a name that does not resolve, and no request but to these origins."""
    errors = [line["message"] for line in browser.get_log("browser") if line["level"] == "SEVERE"]
    assert errors == []
    asked = []
    for line in browser.get_log("performance"):
        message = json.loads(line["message"])["message"]
        for key in ("request", "url"):
            found = message["params"].get(key)
            url = found.get("url") if isinstance(found, dict) else found
            if message["method"] in ("Network.requestWillBeSent", "Network.webSocketCreated") and url:
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
    iterations, cost, shown = viewer._curve.data
    np.testing.assert_array_equal(iterations, np.arange(len(recorded)))
    np.testing.assert_array_equal(cost, recorded)
    np.testing.assert_array_equal(shown, [recorded[0], *[np.nan] * (len(recorded) - 1)])
    check_silent(browser, viewer.url, viewer.url.replace("http", "ws"))


def test_a_click_on_a_frustum_marks_its_points(browser, viewer):
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    browser.get(viewer.url)
    before = like(settled(browser), ORANGE)
    body = browser.find_element(By.TAG_NAME, "body")
    chosen = lambda: viewer.stages[0].chosen is not None
    colours = {tuple(handle.color) for handle in viewer.stages[0].layers.frusta.values()}
    pixels = scene(browser)
    near = np.min([np.abs(pixels - np.array(colour)).max(axis=2) for colour in colours], axis=0) < 25
    rows, columns = np.nonzero(near)
    middle = body.size["width"] // 2, body.size["height"] // 2
    for at in range(0, len(rows), max(len(rows) // 40, 1)):
        x, y = int(columns[at]), int(rows[at])
        ActionChains(browser).move_to_element_with_offset(body, x - middle[0], y - middle[1]).click().perform()
        time.sleep(0.4)
        if chosen():
            break
    assert chosen(), "no frustum was hit"
    wait_for(lambda: like(scene(browser), ORANGE) > before + 100, browser)
    wait_for(lambda: "observations, RMSE" in body.text, browser)


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
    assert "worst images" in browser.find_element("tag name", "body").text
    check_silent(browser, "file://")


def test_a_solve_is_watched_while_it_runs(browser, viewer, recording):
    from dataclasses import replace

    browser.get(viewer.url)
    count = recording.last + 1
    wait_for(lambda: f"iteration {recording.last} of" in browser.find_element("tag name", "body").text, browser)
    rows = ("state", "cost", "damping", "gain_ratio", "time_s")
    longer = {name: np.append(getattr(recording, name), getattr(recording, name)[-1]) for name in rows}
    threading.Thread(target=viewer.grow, args=(replace(recording, **longer),)).start()
    wait_for(lambda: f"iteration {count} of {count}" in browser.find_element("tag name", "body").text, browser)


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
    from jaxba.viewer.page import Viewer, about_rows
    from jaxba.viewer.sources import shown

    problem = recording.problem
    bars = residuals.distance(point=[0, 1, 2], point_2=[3, 4, 5], length=[0.0, 50.0, 0.0], sigma=0.1)
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
        assert f"distance**: cost {costs_of_rows(problem)[0].sum():.5g} of 3 rows; the worst: 1 (" in first
        assert "rgb(0, 158, 115)" in second
    finally:
        viewer.close()


def test_the_command_says_what_is_missing(tmp_path, capsys):
    from jaxba.cli.view import run

    assert run([str(Path(tmp_path) / "no.npz")]) == 2
    assert "cannot read" in capsys.readouterr().err


def test_names_are_characters_and_nothing_else():
    from jaxba.viewer.page import plain

    assert plain("<b>*a*_1") == r"&lt;b&gt;\*a\*\_1"
