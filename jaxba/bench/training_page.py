"""The page that a training ends with: curves, some episodes and its table."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from jaxba.bench import page
from jaxba.bench.charts import SYMBOLS, Chart, Style, axis, chart, hollow, line, solver_styles
from jaxba.bench.tables import Table
from jaxba.game.rollout import Trajectories
from jaxba.solver.figure import COLOURS
from jaxba.training.log import Row

# positions of the switch: gradient updates of an agent, seconds of training
AXES = ("updates", "seconds")
TRAINED = "trained"  # name of the trained policy in charts

HELD_OUT = {"mean": "mean iterations", "p90": "90th percentile", "failures": "failures (%)"}
"""Charts of held-out scores: fields of a `Score` and their titles. The log has `mean` as
`score`."""

EPISODES = 6  # scenes whose episodes are shown

LEARNING = {
    "episode/length": "iterations of a training episode",
    "critic_loss": "loss of the critics",
    "actor_loss": "loss of the actor",
    "q_mean": "value of the critics",
    "q_bias": "bias of the critics",
    "entropy": "entropy (nats; a uniform policy has 0.69)",
    "action_spread": "spread of the mean action over states",
    "temperature": "temperature",
    "steps_per_s": "steps/s",
}
"""Charts of the log of training and their titles; those that a log does not have are left out."""

RULE = Style(COLOURS[-1], "8px,6px", "circle")  # of Ceres' rule, where it is no yardstick


def to_html(
    rows: Sequence[Row],
    rules: Mapping[str, Any],
    table: Table,
    episodes: Trajectories,
    facts: Mapping[str, str],
) -> str:
    """The page: from rows of the log, a `Score` by name of the yardstick, the comparison on the
    held-out scenes, episodes of the best policy, of which the first `EPISODES` are shown, and
    machine, versions and command."""
    styles = solver_styles([TRAINED, *rules])
    agents = len({row["seed"] for row in rows})
    spread = (
        f"Mean of {agents} agents; shaded: from the lowest to the highest. " if agents > 1 else ""
    )
    whole = page.Page("jaxba training", facts, styles, AXES)
    held_out = [_held_out(rows, rules, styles, field) for field in HELD_OUT]
    whole.add(
        "On held-out scenes", page.note(f"{spread}Level: yardsticks."), whole.charts(held_out)
    )
    whole.add_table(table)
    logged = [name for name in LEARNING if name in rows[0]]
    learning = {name: _curve(rows, name, styles[TRAINED]) for name in logged}
    if learning:
        ceres = "Ceres' rule on these scenes"
        learning[logged[0]] += _curve(
            rows, "episode/ceres", styles.get("ceres", RULE), name="ceres", label=ceres
        )
    whole.add(
        "Learning",
        page.note(spread),
        whole.charts([_over(LEARNING[x], learning[x]) for x in logged]),
    )
    whole.add(
        f"The best policy on {min(EPISODES, len(episodes.iterations))} held-out scenes",
        page.note("Every line is a scene. Hollow: the step was rejected."),
        whole.charts(
            [_episodes("damping λ", episodes, 1), _episodes("cost (pixels²)", episodes, 0)]
        ),
    )
    return whole.to_html()


def _over(title: str, traces: Sequence[Chart]) -> Chart:
    x = {"updates": axis("gradient updates"), "seconds": axis("seconds of training")}
    return chart(title, traces, x, axis("", zero=True), height=320)


def _held_out(
    rows: Sequence[Row], rules: Mapping[str, Any], styles: Mapping[str, Style], field: str
) -> Chart:
    """A held-out score over training, and the levels of the yardsticks."""
    scale = 100.0 if field == "failures" else 1.0
    traces = _curve(
        rows, f"held_out/{'score' if field == 'mean' else field}", styles[TRAINED], scale
    )
    ends = {name: [traces[-1]["x"][name][k] for k in (0, -1)] for name in AXES} if traces else {}

    def level(name, one):
        return line(name, ends, [scale * getattr(one, field)] * 2, styles[name], marked=False)

    return _over(
        HELD_OUT[field], [*traces, *(level(name, one) for name, one in rules.items() if traces)]
    )


def _curve(
    rows: Sequence[Row],
    metric: str,
    style: Style,
    scale: float = 1.0,
    name: str = TRAINED,
    label: str = "",
) -> list[Chart]:
    """The mean of a metric over agents, by chunk. Of several agents that are `TRAINED`, also the
    range and each one."""
    chunks: dict[int, tuple[Row, list[float]]] = {}
    for row in rows:
        if row.get(metric) is not None:
            chunks.setdefault(row["chunk"], (row, []))[1].append(scale * row[metric])
    found = [chunks[chunk] for chunk in sorted(chunks)]
    x = {
        "updates": [row["updates"] for row, _ in found],
        "seconds": [row["wall_s"] for row, _ in found],
    }
    values = [agents for _, agents in found]
    most = max(map(len, values), default=0)
    mean = line(
        name, x, [sum(ys) / len(ys) for ys in values], style, label=label, marked=name == TRAINED
    )
    if name != TRAINED or most < 2:
        return [mean] if found or name != TRAINED else []
    shade = "rgba({}, {}, {}, 0.18)".format(*(int(style.color[k : k + 2], 16) for k in (1, 3, 5)))
    edge = {
        "meta": TRAINED,
        "x": x,
        "mode": "lines",
        "line": {"width": 0, "color": style.color},
        "hoverinfo": "skip",
    }
    low, high = ({**edge, "y": [end(ys) for ys in values]} for end in (min, max))

    def of(k):
        return [ys[k] if k < len(ys) else float("nan") for ys in values]

    single = [
        line(TRAINED, x, of(k), style, label=f"agent {k + 1}", marked=False, opacity=0.5)
        for k in range(most)
    ]
    single = [{**one, "line": {**one["line"], "width": 0.7}} for one in single]
    return [low, {**high, "fill": "tonexty", "fillcolor": shade}, mean, *single]


def _episodes(title: str, episodes: Trajectories, start: int) -> Chart:
    """Lambda (from iteration 1) or cost (from 0) over the iterations of some episodes."""
    values = episodes.dampings if start else episodes.costs
    traces = []
    for k, count in enumerate(episodes.iterations[:EPISODES]):
        style = Style(COLOURS[k % len(COLOURS)], "solid", SYMBOLS[k % len(SYMBOLS)])
        rejected = np.diff(episodes.costs[k, : count + 1]) >= 0
        numbers = values[k, : count + 1 - start].tolist()
        one = line(f"scene {k + 1}", list(range(start, count + 1)), numbers, style)
        traces.append(hollow(one, [False] * (1 - start) + rejected.tolist()))
    return chart(
        title, traces, {name: axis("iteration") for name in AXES}, axis("", log=True), height=320
    )
