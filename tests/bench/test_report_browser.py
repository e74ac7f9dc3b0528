"""The report in a browser: it sorts, hovers and switches, without errors and without the
network."""

from __future__ import annotations

import base64
import io
from collections.abc import Iterator
from typing import Any

import browser
import numpy as np
import pytest
from test_bench_report import make_record

from jaxba.bench import report
from jaxba.bench.summary import summarize

pytestmark = pytest.mark.extra

RUNS = {"classic": (30, 0.8), "ceres": (14, 0.5), "a<b>&": (12, 0.3), "twin": (12, 0.3)}
RECORDS = [
    make_record(p, s, n, rate=r) for p in ("first", "<second>") for s, (n, r) in RUNS.items()
]


@pytest.fixture(scope="module")
def opened(tmp_path_factory) -> Iterator[Any]:
    path = tmp_path_factory.mktemp("page") / "report.html"
    path.write_text(report.to_html(RECORDS, summarize(RECORDS)), encoding="utf-8")
    with browser.chromium() as driver:
        driver.get(path.as_uri())
        yield driver


@pytest.fixture
def page(opened) -> Iterator[Any]:
    """The page as it opens; after the test, nothing was complained about or asked for."""
    opened.refresh()
    yield opened
    assert browser.complaints(opened) == []
    assert browser.requests(opened) == []


def click(page: Any, selector: str) -> None:
    page.execute_script("document.querySelector(arguments[0]).click()", selector)


def chart(page: Any, title: str) -> str:
    """Id of the chart under a title, the shown one."""
    code = (
        "return [...document.querySelectorAll('figure')].find(f => "
        "f.querySelector('h3').textContent === arguments[0]"
        " && !f.closest('[hidden]')).querySelector('div').id"
    )
    return page.execute_script(code, title)


def traces(page: Any, name: str) -> dict[str, dict]:
    code = (
        "return document.getElementById(arguments[0]).data.map(t => ({meta: t.meta, x: t.x, y: "
        "t.y}))"
    )
    return {trace["meta"]: trace for trace in page.execute_script(code, name)}


def pixels(page: Any, name: str) -> np.ndarray:
    from PIL import Image

    png = page.find_element("id", name).screenshot_as_base64
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))).convert("RGB")).astype(int)


def column(page: Any, title: str, number: int) -> list[str]:
    code = (
        "return [...[...document.querySelectorAll('section')].find(s => "
        "s.querySelector('h2').textContent ==="
        " arguments[0]).querySelectorAll('tbody tr')].map(r => r.cells[arguments[1]].textContent)"
    )
    return page.execute_script(code, title, number)


def test_a_click_on_a_head_sorts_by_number_and_a_second_one_the_other_way(page):
    head = "[...document.querySelectorAll('th')].find(t => t.textContent === 'final cost').click()"
    page.execute_script(head)
    found = [float(text) for text in column(page, "Problems", 5)]
    assert found == sorted(found)
    assert len(set(found)) > 2
    page.execute_script(head)
    assert [float(text) for text in column(page, "Problems", 5)] == sorted(found, reverse=True)


def test_the_switch_and_the_choice_of_problem_show_the_numbers_of_the_records(page):
    name = chart(page, "Accepted cost (pixels²)")
    record = RECORDS[1]
    shown = traces(page, name)["ceres"]
    assert shown["x"] == [p.iteration for p in record.trace]
    assert shown["y"] == pytest.approx([p.cost for p in record.trace], rel=1e-6)
    before = pixels(page, name)
    click(page, "[data-axis=time]")
    assert traces(page, name)["ceres"]["x"] == pytest.approx(
        [p.time_s for p in record.trace], rel=1e-6
    )
    page.execute_script(
        "const s = document.getElementById('group'); s.value = '1'; s.dispatchEvent(new "
        "Event('change'))"
    )
    other = chart(page, "Accepted cost (pixels²)")
    assert other != name
    assert set(traces(page, other)) == set(RUNS)
    assert np.abs(pixels(page, other) - before).max() > 100


def test_a_point_under_the_pointer_has_a_note_with_all_solvers_and_their_numbers(page):
    from selenium.webdriver import ActionChains

    name = chart(page, "Damping λ")
    code = "return [...document.querySelectorAll(`#${arguments[0]} .scatterlayer .trace`)].length"
    assert page.execute_script(code, name) == len(RUNS)
    point = page.find_elements("css selector", f"#{name} .scatterlayer .trace:nth-child(3) .point")[
        2
    ]
    page.execute_script("arguments[0].scrollIntoView({block: 'center'})", point)
    ActionChains(page).move_to_element(point).perform()
    text = page.execute_script(
        "return document.querySelector(`#${arguments[0]} .hoverlayer`).textContent", name
    )
    assert "iteration: 3" in text
    assert all(f"{name} 3: cost " in text for name in RUNS)


def test_a_solver_is_hidden_in_every_chart_and_table(page):
    profile = chart(page, "τ = 0.001")
    assert set(traces(page, profile)) == set(RUNS)
    click(page, ".chip[data-key=ceres]")
    for title in ("τ = 0.1", "τ = 0.001", "f*(1+0.0001)", "Accepted cost (pixels²)", "Damping λ"):
        assert set(traces(page, chart(page, title))) == set(RUNS) - {"ceres"}
    assert page.execute_script(
        "return [...document.querySelectorAll('tr[data-key=ceres]')].every(r => r.hidden)"
    )


def test_no_button_of_a_chart_sends_it_anywhere(page):
    titles = page.execute_script(
        "return [...document.querySelectorAll('.modebar-btn')].map(b => b.dataset.title)"
    )
    assert set(titles) == {"Download plot", "Zoom", "Pan", "Reset axes"}
    made = "Plotly.toImage('chart0', {format: 'svg'}).then(arguments[0], arguments[0])"
    assert page.execute_async_script(made).startswith("data:image/svg+xml,")


def test_dark_and_light_differ_and_black_curves_turn_white(page):
    light = pixels(page, chart(page, "τ = 0.1"))
    click(page, "#theme")
    dark = pixels(page, chart(page, "τ = 0.1"))
    assert light[2, 2].min() > 240
    assert dark[2, 2].max() < 40
    assert (dark.min(axis=2) > 240).any()
