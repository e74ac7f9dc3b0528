"""The page that a training run ends with: curves, some episodes of the policy, and its table."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxba.bench import page
from jaxba.bench.page import Chart
from jaxba.bench.plots import Style, solver_styles
from jaxba.bench.tables import Table
from jaxba.game.rollout import Trajectories
from jaxba.training.log import Row

AXES = ("updates", "seconds")
"""Positions of the switch: gradient updates of an agent, seconds of training."""

TRAINED = "trained"
"""Name of the trained policy in charts."""

HELD_OUT = {"mean": "mean iterations", "p90": "90th percentile", "failures": "failures (%)"}
"""Charts of held-out scores: fields of a `Score` and their titles. The log has `mean` as `score`."""

EPISODES = 6
"""Scenes whose episodes are shown."""

LEARNING = {
    "episode/length": "iterations of a training episode",
    "critic_loss": "loss of the critics",
    "actor_loss": "loss of the actor",
    "q_mean": "value of the critics",
    "temperature": "temperature",
    "steps_per_s": "steps/s",
}
"""Charts of the log of training and their titles; those that a log does not have are left out."""


def to_html(
    rows: Sequence[Row],
    rules: Mapping[str, Any],
    table: Table,
    episodes: Trajectories,
    facts: Mapping[str, str],
) -> str:
    """The page.

    Args:
        rows: of the log.
        rules: a `Score` by name of the yardstick.
        table: the comparison on the held-out scenes.
        episodes: of the best policy; the first `EPISODES` are shown.
        facts: machine, versions, command.
    """
    styles = solver_styles([TRAINED, *rules])
    log_name = lambda field: f"held_out/{'score' if field == 'mean' else field}"
    curves = [
        _curve(rows, log_name(field), title, styles, {n: getattr(one, field) for n, one in rules.items()}, field)
        for field, title in HELD_OUT.items()
    ]
    usual = "episode/ceres"
    learning = [_curve(rows, name, title, styles, {}, name) for name, title in LEARNING.items() if name in rows[0]]
    for chart in learning[:1]:
        chart.traces.append(_line(rows, usual, "Ceres' rule on these scenes", styles.get("ceres"), "ceres"))
    played = _episode_charts(episodes)
    every = [*curves, *learning, *played]
    numbered = list(enumerate(every))
    first, second = len(curves), len(curves) + len(learning)
    agents = len({row["seed"] for row in rows})
    spread = f"Mean of {agents} agents; shaded: from the lowest to the highest. " if agents > 1 else ""
    sections = [
        page.section("On held-out scenes", page.note(f"{spread}Level: yardsticks."), page.charts(numbered[:first])),
        page.table(table, styles),
        page.section("Learning", page.note(spread), page.charts(numbered[first:second])),
        page.section(
            f"The best policy on {min(EPISODES, len(episodes.iterations))} held-out scenes",
            page.note("Every line is a scene. Hollow: the step was rejected."),
            page.charts(numbered[second:]),
        ),
    ]
    return page.to_html(page.Page("jaxba training", facts, sections, every, styles, AXES))


def _x(rows: Sequence[Row]) -> dict[str, list[Any]]:
    return {"updates": [row["updates"] for row in rows], "seconds": [row["wall_s"] for row in rows]}


def _by_chunk(rows: Sequence[Row], name: str) -> list[tuple[Row, list[float]]]:
    """The first row of every chunk that has the metric, and the metric of all agents."""
    found: dict[int, tuple[Row, list[float]]] = {}
    for row in rows:
        if row.get(name) is not None:
            found.setdefault(row["chunk"], (row, []))[1].append(row[name])
    return [found[chunk] for chunk in sorted(found)]


def _line(rows: Sequence[Row], name: str, label: str, style: Style | None, meta: str) -> dict[str, Any]:
    found = _by_chunk(rows, name)
    look = page.line(style, 1.5) if style else {"color": "#7F7F7F", "dash": "dash", "width": 1.5}
    y = [sum(values) / len(values) for _, values in found]
    return {"name": label, "meta": meta, "x": _x([row for row, _ in found]), "y": y, "mode": "lines", "line": look}


def _curve(
    rows: Sequence[Row], name: str, title: str, styles: Mapping[str, Style], rules: Mapping[str, float], field: str
) -> Chart:
    """Mean and range of a metric over agents, each agent as a thin line, and the yardsticks."""
    found, style = _by_chunk(rows, name), styles[TRAINED]
    scale = 100.0 if field == "failures" else 1.0
    x, values = _x([row for row, _ in found]), [[scale * v for v in ys] for _, ys in found]
    several = any(len(ys) > 1 for ys in values)
    traces: list[dict[str, Any]] = []
    if several:
        edge = {
            "x": x,
            "meta": TRAINED,
            "mode": "lines",
            "line": {"width": 0, "color": style.color},
            "hoverinfo": "skip",
        }
        traces.append({**edge, "y": [min(ys) for ys in values]})
        traces.append({**edge, "y": [max(ys) for ys in values], "fill": "tonexty", "fillcolor": _faint(style.color)})
        for k in range(max(map(len, values))):
            own = [ys[k] if k < len(ys) else None for ys in values]
            hover = f"agent {k + 1}: %{{y:.4g}}<extra></extra>"
            thin = {"width": 0.7, "color": style.color}
            traces.append(
                {
                    "x": x,
                    "y": own,
                    "meta": TRAINED,
                    "mode": "lines",
                    "line": thin,
                    "opacity": 0.5,
                    "hovertemplate": hover,
                }
            )
    mean = [sum(ys) / len(ys) for ys in values]
    marker = {"symbol": page.SYMBOLS[style.marker], "size": 6, "color": style.color}
    line = page.line(style, 2.5)
    hover = "<b>trained</b><br>%{x:.4g}: %{y:.4g}<extra></extra>"
    traces.append(
        {"x": x, "y": mean, "name": TRAINED, "meta": TRAINED, "mode": "lines+markers", "line": line}
        | {"marker": marker, "hovertemplate": hover}
    )
    for rule, value in rules.items():
        ends = {axis: [xs[0], xs[-1]] if xs else [] for axis, xs in x.items()}
        hover = f"<b>{html.escape(rule)}</b>: {scale * value:.4g}<extra></extra>"
        flat = {"x": ends, "y": [scale * value] * 2, "name": html.escape(rule), "meta": rule, "mode": "lines"}
        traces.append({**flat, "line": page.line(styles[rule], 1.5), "hovertemplate": hover})
    layout: dict[str, Any] = {"height": 320, "yaxis": {"rangemode": "tozero"}}
    xaxes = {"updates": {"title": {"text": "gradient updates"}}, "seconds": {"title": {"text": "seconds of training"}}}
    return Chart(title, traces, layout, "", xaxes)


def _faint(color: str) -> str:
    return "rgba({}, {}, {}, 0.18)".format(*(int(color[k : k + 2], 16) for k in (1, 3, 5)))


def _episode_charts(episodes: Trajectories) -> list[Chart]:
    """Lambda and cost over the iterations of some episodes."""
    from jaxba.bench.plots import MARKERS
    from jaxba.solver.figure import COLOURS

    def chart(title: str, rows: np.ndarray, starts: int) -> Chart:
        traces = []
        for k, count in enumerate(episodes.iterations[:EPISODES]):
            color, symbol = COLOURS[k % len(COLOURS)], page.SYMBOLS[MARKERS[k % len(MARKERS)]]
            numbers = rows[k, : count + 1 - starts].tolist()
            accepted = np.diff(episodes.costs[k, : count + 1]) < 0
            symbols = [symbol if ok else f"{symbol}-open" for ok in [True] * (1 - starts) + accepted.tolist()]
            traces.append(
                {"x": list(range(starts, count + 1)), "y": numbers, "name": f"scene {k + 1}", "mode": "lines+markers"}
                | {"line": {"color": color, "width": 1.5}, "marker": {"symbol": symbols, "size": 7, "color": color}}
                | {"hovertemplate": f"<b>scene {k + 1}</b>, iteration %{{x}}<br>%{{y:.4g}}<extra></extra>", "meta": ""}
            )
        log = {"type": "log", "exponentformat": "power", "minorloglabels": "none"}
        return Chart(title, traces, {"xaxis": {"title": {"text": "iteration"}}, "yaxis": log, "height": 320})

    return [chart("damping λ", episodes.dampings, 1), chart("cost (pixels²)", episodes.costs, 0)]
