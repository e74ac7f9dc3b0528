"""The lines of text that a training prints after each chunk."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from jaxba.training.log import Row

YARDSTICKS = ("ceres", "constant action")  # baselines beside which held-out scores are printed
MOST_ENTROPY = math.log(2)  # nats of a uniform action in (-1, 1)
# nats below `MOST_ENTROPY` within which a policy acts at random: over nine tenths of the range
RANDOM = 0.1
# decades of lambda; a policy with a smaller spread over states does the same in every state
SAME = 0.1


def lines(
    rows: Sequence[Row],
    chunks: int,
    rules: Mapping[str, Any],
    best: bool = False,
    decades: float = 5.5,
    left_s: float = 0.0,
) -> list[str]:
    """A line on a finished chunk and one on the agents' health, and one on held-out scores if there
    are any. The last one is a warning if there are scores, and some agents' policies are the same
    everywhere or random. Rows are those of one chunk in the log, one of every agent, of so many
    chunks in all; `rules` has a `Score` by name of the baseline. `best`: whether a policy of this
    chunk is the best so far. `decades`: of lambda that an action of 1 is above 0. `left_s`: seconds
    that the other chunks will take."""
    row = rows[0]
    start = f"chunk {row['chunk']}/{chunks}: "
    text = f"{row['steps_per_s']:.0f} steps/s, {row['updates_per_s']:.0f} updates/s"
    if ended := [one for one in rows if one["episodes"]]:
        length = _mean(ended, "episode/length")
        rule = _mean(ended, "episode/ceres")
        text += f", {length:.1f} iterations (Ceres' rule {rule:.1f})"
    health = f"critics' loss {_mean(rows, 'critic_loss'):.2g}"
    if any(one["q_bias"] is not None for one in rows):
        health += f", bias {_mean(rows, 'q_bias'):+.2g} of {_mean(rows, 'q_mean'):.2g}"
    health += f", entropy {_mean(rows, 'entropy'):.2f} nats, {_spread(rows, decades)}"
    found = [f"{start}{text}, about {left_s:.0f} s left", start + health]
    values = [one["held_out/score"] for one in rows if one.get("held_out/score") is not None]
    if values:
        text = f"held out {_mean(rows, 'held_out/score'):.2f} iterations"
        text += f" ({min(values):.2f} to {max(values):.2f})" if len(rows) > 1 else ""
        text += f", p90 {_mean(rows, 'held_out/p90'):.0f}"
        text += f", failures {100 * _mean(rows, 'held_out/failures'):.1f} %"
        shown = [f"{name} {rules[name].mean:.2f}" for name in YARDSTICKS if name in rules]
        text += f" ({', '.join(shown)})" if shown else ""
        found.append(f"{start}{text}{', best on training scenes so far' if best else ''}")
        found += _warning(rows, decades)
    return found


def _spread(rows: Sequence[Row], decades: float) -> str:
    values = ", ".join(f"{decades * row['action_spread']:.2f}" for row in rows)
    return f"spread of log10(lambda) over states {values}"


def _warning(rows: Sequence[Row], decades: float) -> list[str]:
    """What is said if some agents do the same in every state, or anything in every state."""
    same = [row for row in rows if decades * row["action_spread"] < SAME]
    random = [row for row in rows if row["entropy"] > MOST_ENTROPY - RANDOM]

    def who(some):
        return "this policy" if len(rows) == 1 else f"{len(some)} of {len(rows)} policies"

    def does(some):
        return "does" if len(rows) == 1 else "do"

    found = []
    if same:
        found.append(f"{who(same)} {does(same)} the same in every state ({_spread(same, decades)})")
    if random:
        values = ", ".join(f"{row['entropy']:.2f}" for row in random)
        found.append(
            f"{who(random)} {does(random)} anything at random (entropy {values} of "
            f"{MOST_ENTROPY:.2f} nats)"
        )
    return [f"warning: {'; '.join(found)}"] if found else []


def _mean(rows: Sequence[Row], name: str) -> float:
    values = [row[name] for row in rows if row.get(name) is not None]
    return sum(values) / len(values)
