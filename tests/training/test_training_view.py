"""The lines that a training prints, and the page that it ends with."""

from __future__ import annotations

import json
import re

import browser
import numpy as np
import pytest

from jaxba.bench import training_page
from jaxba.bench.tables import Table
from jaxba.game.evaluate import Score
from jaxba.game.rollout import Trajectories
from jaxba.training import view

RULES = {
    "ceres": Score(6.0, 5.5, 6.0, 9.0, 0.02, 12.0, 1e-3),
    "constant action": Score(5.0, 4.5, 5.0, 7.0, 0.0, 10.0, 1e-4),
}


def rows(chunk: int, scores: tuple[float, ...] | None = None) -> list[dict]:
    """The rows of a chunk of three agents."""
    found = []
    for k in range(3):
        row = {
            "seed": k,
            "chunk": chunk,
            "updates": 8 * chunk,
            "wall_s": 1.5 * chunk,
            "episodes": 4.0,
        }
        row |= {
            "steps_per_s": 1234.0,
            "updates_per_s": 56.0,
            "episode/length": 5.0 + k,
            "episode/ceres": 7.5,
        }
        row |= {
            "critic_loss": 0.25,
            "q_bias": 0.5,
            "q_mean": -2.0,
            "entropy": -0.5,
            "action_spread": 0.1 * k,
        }
        if scores:
            row |= {"held_out/score": scores[k], "held_out/p90": 6.0, "held_out/failures": 0.01}
        found.append(row)
    return found


def test_a_chunk_has_a_line_and_its_held_out_scores_another():
    first, health, second, warning = view.lines(
        rows(1, (5.0, 6.0, 7.0)), 4, RULES, best=True, decades=6.0, left_s=5.2
    )
    assert (
        first
        == "chunk 1/4: 1234 steps/s, 56 updates/s, 6.0 iterations (Ceres' rule 7.5), about 5 s left"
    )
    assert second.startswith("chunk 1/4: held out 6.00 iterations (5.00 to 7.00)")
    assert second.endswith(
        ", failures 1.0 % (ceres 6.00, constant action 5.00), best on training scenes so far"
    )
    spread = "spread of log10(lambda) over states"
    assert health.endswith(
        f"critics' loss 0.25, bias +0.5 of -2, entropy -0.50 nats, {spread} 0.00, 0.60, 1.20"
    )
    assert warning == f"warning: 1 of 3 policies do the same in every state ({spread} 0.00)"
    assert len(view.lines(rows(2), 4, RULES)) == 2


def test_a_policy_that_learned_nothing_is_called_that_once_in_plain_words():
    row = rows(1, (5.0, 6.0, 7.0))[1]

    def said(**changed):
        return view.lines([row | changed], 4, RULES, decades=6.0)[3:]

    assert said() == []
    assert said(q_bias=None) == []
    (same,) = said(action_spread=0.003)
    assert same.endswith(
        "this policy does the same in every state (spread of log10(lambda) over states 0.02)"
    )
    (both,) = said(action_spread=0.003, entropy=0.67)
    assert both.endswith("; this policy does anything at random (entropy 0.67 of 0.69 nats)")
    assert said(entropy=0.5) == []


COSTS = 8.0 - np.tile([0, 1, 1, 2, 3, 4, 5, 6], (2, 1))
"""Of two episodes, of five and seven iterations; the second of each is rejected."""

EPISODES = Trajectories(COSTS, 10.0 ** -COSTS[:, 1:], np.array([5, 7]), np.array([True, True]))


def page_of() -> str:
    log = [*rows(1), *rows(2, (5.0, 6.0, 7.0)), *rows(3), *rows(4, (3.0, 4.0, 5.5))]
    table = Table("Scores", ("policy", "mean"), [("trained", "4.17"), ("<b>", "1")], "")
    return training_page.to_html(log, RULES, table, EPISODES, {"command": "jaxba-train <x>"})


def test_the_page_has_mean_range_yardsticks_and_the_policys_lambda():
    text = page_of()
    assert "&lt;x&gt;" in text
    assert '<td class="name">&lt;b&gt;</td>' in text
    assert '<tr data-key="trained">' in text
    book = json.loads(re.findall(r'id="book">(.*?)</script>', text, re.DOTALL)[0])
    charts = dict(zip(re.findall("<h3>(.*?)</h3>", text), book["charts"], strict=True))
    low, high, *_ = mean = charts["mean iterations"]["data"]
    assert [low["y"], high["y"]] == [[5.0, 3.0], [7.0, 5.5]]
    trained = next(trace for trace in mean if trace.get("name") == "trained")
    assert trained["x"] == {"updates": [16, 32], "seconds": [3.0, 6.0]}
    np.testing.assert_allclose(trained["y"], [6.0, 12.5 / 3], rtol=1e-6)
    ceres = next(trace for trace in mean if trace.get("name") == "ceres")
    assert ceres["y"] == [6.0, 6.0]
    for trace, row, count in zip(
        charts["damping λ"]["data"], EPISODES.dampings, (5, 7), strict=True
    ):
        np.testing.assert_allclose(trace["y"], row[:count], rtol=1e-6)
        assert [
            k for k, symbol in enumerate(trace["marker"]["symbol"]) if symbol.endswith("-open")
        ] == [1]


@pytest.mark.extra
def test_the_page_is_drawn_without_errors_and_without_the_network(tmp_path):
    path = tmp_path / "report.html"
    path.write_text(page_of(), encoding="utf-8")
    with browser.chromium() as page:
        page.get(path.as_uri())
        count = page.execute_script(
            "return document.querySelectorAll('.scatterlayer .trace').length"
        )
        assert count > 2 * len(EPISODES.iterations)
        title = "return document.querySelector('.xtitle').textContent"
        assert page.execute_script(title) == "gradient updates"
        page.execute_script("document.querySelector('[data-axis=seconds]').click()")
        assert page.execute_script(title) == "seconds of training"
        assert browser.complaints(page) == []
        assert browser.requests(page) == []
