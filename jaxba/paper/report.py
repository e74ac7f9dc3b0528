"""The report: claims, readings, every table and figure, the machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxba.bench.run import machine
from jaxba.bench.tables import number
from jaxba.paper.claims import CRITERION
from jaxba.paper.config import to_yaml
from jaxba.paper.markdown import Section, claims_table, table
from jaxba.paper.pieces import figures
from jaxba.paper.workshop import Workshop
from jaxba.runtime.atomic import atomic_write, write_text

ALONE = 0.9
"""Processor seconds per second from which on a program was not held up by others."""

READINGS: tuple[tuple[str, str, str], ...] = (
    (
        "damping",
        "text: `H + λI`; code: `diag(H)(1 + λ)`",
        "`H + λ diag(H)`, clamped as Ceres does; a λ is then scale-free",
    ),
    (
        "classic rule",
        "text: halve λ when the error rose; code: halve it after a gain above 0.4, double it otherwise; first λ 1/4 "
        "(text) or 3e-2 (code)",
        "the code's directions, the text's 1/4",
    ),
    ("rejected steps", "not stated; the code restores the state", "rejected, and counted as an iteration"),
    (
        "stopping",
        "text: 1e-6; code: absolute cost below 1e-10",
        "relative decrease of an accepted step below 1e-6, not of one that damping made short",
    ),
    (
        "unknowns",
        "camera poses and points",
        "the same on the synthetic scenes; on real problems BAL's nine numbers a camera",
    ),
    (
        "synthetic scenes",
        "text: random poses and points; code: cameras on a line, noise-free bearings",
        "cameras on a line, pixels with half a pixel of noise, or no relative tolerance would make sense",
    ),
    (
        "state",
        "text: last five errors; code: one predicted decrease, un-normalised",
        "the text's, root mean square in pixels, at most 1000",
    ),
    ("action", "text: λ in [0, ∞); code: tanh, half of it is λ = 1e-15", "tanh over log10 λ from -10 to 2"),
    ("reward", "measured seconds, bonus 10", "1 an iteration, deterministic; bonus 10"),
    (
        "episode's end",
        "the stopping rule",
        "within 1e-3 of the best cost known for the scene; the tables count the stopping rule",
    ),
    (
        "networks",
        "text: value and critics of three layers of 256, policy of four; code: fewer",
        "two hidden layers of 256 and an output each",
    ),
    (
        "time delay",
        "text: 5 iterations between the critics; code: a soft target 0.01",
        "the target value network is copied every 5 updates",
    ),
    ("temperature", "code: fixed at 1", "fixed at 1"),
    (
        "choice of the policy",
        "code: fewest iterations seen in training",
        "fewest on held-out scenes; the tables use a third set of scenes, and all seeds",
    ),
    ("success", "within 100 iterations", "the same; a failure counts as 100 in every mean"),
    (
        "train and test sets",
        "not stated for BAL and KITTI",
        "trained on synthetic scenes alone, tested on real problems",
    ),
)
"""What the paper's text and its released code leave open or contradict, and the reading taken."""


def write(
    shop: Workshop, sections: Sequence[Section], path: Path, command: str, seconds: Mapping[str, tuple[float, float]]
) -> list[Path]:
    """Writes the report and puts the pictures beside it.

    Args:
        shop: of the run.
        sections: in order.
        path: of the Markdown file; pictures go into a folder of its stem.
        command: that made it.
        seconds: of the wall clock and of the processor that this folder spent on each piece.

    Returns:
        All files written. Raises OSError.
    """
    pictures = path.parent / path.stem
    files = []
    drawn = sorted((shop.folder / figures.FIGURES).glob("*.png"))
    if drawn:
        pictures.mkdir(parents=True, exist_ok=True)
    for source in drawn:
        target = pictures / source.name
        with atomic_write(target) as file:
            file.write(source.read_bytes())
        files.append(target)
    text = _text(shop, sections, command, seconds).replace(f"]({figures.FIGURES}/", f"]({path.stem}/")
    write_text(path, text)
    return [path, *files]


def _text(shop: Workshop, sections: Sequence[Section], command: str, seconds: Mapping[str, tuple[float, float]]) -> str:
    facts = machine()
    claims = [claim for section in sections for claim in section.claims]
    tally = {
        verdict: sum(c.verdict == verdict for c in claims) for verdict in ("reproduced", "partly", "not", "not run")
    }
    config = shop.config
    parts = [
        "# The paper, table by table",
        'Belder, Vivanti, Tal, "A Game of Bundle Adjustment - Learning Efficient Convergence", ICCV 2023, beside '
        "what jaxba "
        f"measures. This file is made by `{command}`; nothing in it is written by hand.",
        f"Machine: {facts['device']}, {facts['processor']}, Python {facts['python']}, JAX {facts['jax']}, jaxba "
        f"{facts['jaxba']}. "
        f"Agents: {config.agents.seeds} training runs of each kind, none picked. All arithmetic in float64. An "
        "iteration is one "
        "linear solve, accepted or rejected. Means are arithmetic, as the paper's; **a failure counts as 100 "
        "iterations**. "
        "`good ends`: share that ends within 1 % of the best cost that anything in this run found. `seeds: range`: "
        "number of "
        "training runs and the range of their means.",
        "## Claims",
        "; ".join(f"{count} {verdict}" for verdict, count in tally.items()) + f" of {len(claims)}.",
        CRITERION,
        claims_table(claims) if claims else "None was looked at.",
        "## What the paper leaves open, and the reading taken",
        table(("what", "paper: text and released code", "here"), READINGS, 3),
    ]
    for section in sections:
        parts += [f"## {section.title}", *(paragraph for paragraph in section.body if paragraph)]
    parts += ["## Settings", f"```yaml\n{to_yaml(config).strip()}\n```"]
    if seconds:
        wall, cpu = (sum(pair[k] for pair in seconds.values()) for k in (0, 1))
        cells = [(name, number(pair[0]), number(pair[1])) for name, pair in seconds.items()]
        parts += ["## Time", table(("piece", "s", "processor s"), [*cells, ("together", number(wall), number(cpu))])]
        parts.append(
            f"Compilation included. The program had {cpu / wall:.2f} processor cores on average"
            + ("; it had to wait for others, and all seconds here are too long." if cpu < ALONE * wall else ".")
        )
    return "\n\n".join(parts) + "\n"
