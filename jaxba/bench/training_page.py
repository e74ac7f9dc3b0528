"""What a training ends with: the figure of its curves, and a page with these, some episodes and its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from jaxba.bench import page, plots
from jaxba.bench.panels import MARKERS, Axis, Panel, Series, Style, on, solver_styles
from jaxba.bench.tables import Table
from jaxba.game.rollout import Trajectories
from jaxba.solver.figure import COLOURS
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

_X = {"updates": Axis("gradient updates"), "seconds": Axis("seconds of training")}
_FROM_ZERO = Axis("", from_zero=True)


def held_out_panels(rows: Sequence[Row], rules: Mapping[str, Any]) -> list[Panel]:
    """Held-out scores over training, and the levels of the yardsticks.

    Args:
        rows: of the log; those without an evaluation are left out.
        rules: a `Score` by name of the yardstick.
    """
    styles = solver_styles([TRAINED, *rules])
    panels = []
    for field, title in HELD_OUT.items():
        scale = 100.0 if field == "failures" else 1.0
        lines = _curve(rows, f"held_out/{'score' if field == 'mean' else field}", styles[TRAINED], scale)
        ends = {axis: [on(lines[-1].x, axis)[k] for k in (0, -1)] for axis in AXES} if lines else []
        for name, one in rules.items() if lines else ():
            lines.append(Series(name, ends, [scale * getattr(one, field)] * 2, styles[name], marked=False))
        panels.append(Panel(title, lines, _X, _FROM_ZERO, height=320))
    return panels


def plot_curve(panels: Sequence[Panel], tolerance: float, agents: int) -> Figure:
    """The figure of `held_out_panels`, over gradient updates.

    Args:
        panels: of `held_out_panels`.
        tolerance: of success, for the label.
        agents: whose mean and range is shown.
    """
    shown = [panel for panel in panels if any(one.name == TRAINED for one in panel.series)]
    label = TRAINED if agents == 1 else f"{TRAINED}, mean and range of {agents} agents"
    rename = lambda one: replace(one, label=label) if one.name == TRAINED and not one.thin else one
    shown = [replace(panel, series=[rename(one) for one in panel.series]) for panel in shown]
    figure = plots.plot_curves(shown, "updates")
    figure.axes[0].set_ylabel(f"to f*(1 + {tolerance:g}) on held-out scenes")
    return figure


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
    curves = held_out_panels(rows, rules)
    logged = {name: title for name, title in LEARNING.items() if name in rows[0]}
    learning = [
        Panel(title, _curve(rows, name, styles[TRAINED]), _X, _FROM_ZERO, height=320) for name, title in logged.items()
    ]
    for panel in learning[:1]:
        (usual,) = _curve(rows, "episode/ceres", styles.get("ceres", Style(COLOURS[-1], (0, (4, 3)), "o")), alone=True)
        panel.series.append(replace(usual, name="ceres", label="Ceres' rule on these scenes", marked=False))
    every = [*curves, *learning, *_episode_panels(episodes)]
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


def _curve(rows: Sequence[Row], name: str, style: Style, scale: float = 1.0, alone: bool = False) -> list[Series]:
    """A metric over the chunks that have it: of several agents each one, unless `alone`, then the mean and its
    range."""
    chunks: dict[int, tuple[Row, list[float]]] = {}
    for row in rows:
        if row.get(name) is not None:
            chunks.setdefault(row["chunk"], (row, []))[1].append(scale * row[name])
    found = [chunks[chunk] for chunk in sorted(chunks)]
    x = {"updates": [row["updates"] for row, _ in found], "seconds": [row["wall_s"] for row, _ in found]}
    values = [agents for _, agents in found]
    most = max(map(len, values), default=0)
    mean = Series(TRAINED, x, [sum(ys) / len(ys) for ys in values], style)
    if alone or most < 2:
        return [mean] if found or alone else []
    of = lambda k: [ys[k] if k < len(ys) else float("nan") for ys in values]
    single = [Series(TRAINED, x, of(k), style, f"agent {k + 1}", thin=True) for k in range(most)]
    return [replace(mean, between=([min(ys) for ys in values], [max(ys) for ys in values])), *single]


def _episode_panels(episodes: Trajectories) -> list[Panel]:
    """Lambda and cost over the iterations of some episodes."""

    def panel(title: str, values: np.ndarray, start: int) -> Panel:
        lines = []
        for k, count in enumerate(episodes.iterations[:EPISODES]):
            style = Style(COLOURS[k % len(COLOURS)], "-", MARKERS[k % len(MARKERS)])
            rejected = np.diff(episodes.costs[k, : count + 1]) >= 0
            hollow = [False] * (1 - start) + rejected.tolist()
            numbers = values[k, : count + 1 - start].tolist()
            lines.append(Series(f"scene {k + 1}", list(range(start, count + 1)), numbers, style, hollow=hollow))
        return Panel(title, lines, {x: Axis("iteration") for x in AXES}, Axis("", log=True), height=320)

    return [panel("damping λ", episodes.dampings, 1), panel("cost (pixels²)", episodes.costs, 0)]
