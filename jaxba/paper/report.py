"""The report in Markdown: claims, interpretations of the paper, all tables and figures, settings and times."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from jaxba.bench.run import machine
from jaxba.bench.tables import number
from jaxba.paper.agents import updates
from jaxba.paper.claims import CRITERION
from jaxba.paper.config import to_yaml
from jaxba.paper.markdown import Section, claims_table, table
from jaxba.paper.runner import Runner
from jaxba.paper.tables_and_figures import figures
from jaxba.runtime.atomic import atomic_write, write_text

CLAIMS = "claims.md"
"""File of the table of claims alone, in the folder of the run."""

BUSY_CORES = 0.9
"""With fewer processor cores in use on average, other programs must have slowed the run down."""

INTERPRETATIONS = "interpretations.md"
"""Section on the subjects on which the paper's text and its released code are open or contradict each other: what both
say, and what is done here. Beside this module."""


def write(
    runner: Runner, sections: Sequence[Section], path: Path, command: str, seconds: Mapping[str, tuple[float, float]]
) -> list[Path]:
    """Writes the report and its table of claims, and copies the figures into a folder beside the report.

    Args:
        runner: the run, with its settings and results.
        sections: sections of the tables and figures, in order.
        path: the Markdown file; figures go into a folder with the same stem.
        command: command line that made the report.
        seconds: for each table or figure, wall-clock time and processor time spent on it in this folder.

    Returns:
        All files written.

    Raises:
        OSError: a file cannot be written.
    """
    pictures = path.parent / path.stem
    files = []
    drawn = sorted((runner.folder / figures.FIGURES).glob("*.png"))
    if drawn:
        pictures.mkdir(parents=True, exist_ok=True)
    for source in drawn:
        target = pictures / source.name
        with atomic_write(target) as file:
            file.write(source.read_bytes())
        files.append(target)
    claims = _claims(runner, sections, command)
    rest = "\n\n".join(_rest(runner, sections, seconds)).replace(f"]({figures.FIGURES}/", f"]({path.stem}/")
    write_text(path, f"{claims}\n{rest}\n")
    write_text(runner.folder / CLAIMS, claims)
    return [path, runner.folder / CLAIMS, *files]


def _claims(runner: Runner, sections: Sequence[Section], command: str) -> str:
    """What the report begins with: how it was made, and the table of claims."""
    properties = machine()
    claims = [claim for section in sections for claim in section.claims]
    tally = {status: sum(c.status == status for c in claims) for status in ("reproduced", "partly", "not", "not run")}
    agents = runner.config.agents
    parts = [
        "# The paper, claim by claim",
        'Belder, Vivanti, Tal, "A Game of Bundle Adjustment - Learning Efficient Convergence", ICCV 2023, beside what '
        f"jaxba measures. This file is made by `{command}`; nothing in it is written by hand.",
        f"Machine: {properties['device']}, {properties['processor']}, Python {properties['python']}, "
        f"JAX {properties['jax']}, jaxba {properties['jaxba']}. "
        f"Agents: {agents.seeds} training runs of each kind, of {updates(runner.config)} updates, all of which enter "
        "the tables. All arithmetic is in float64. An iteration is one linear solve, accepted or rejected. Means are "
        "arithmetic, as in the paper; **a failure counts as 100 iterations**.",
        "## Claims",
        "; ".join(f"{count} {status}" for status, count in tally.items()) + f" of {len(claims)}.",
        CRITERION,
        claims_table(claims) if claims else "None was tested.",
    ]
    return "\n\n".join(parts) + "\n"


def _rest(runner: Runner, sections: Sequence[Section], seconds: Mapping[str, tuple[float, float]]) -> list[str]:
    """What follows the claims: interpretations, every table and figure, settings and times."""
    parts = [
        Path(__file__).with_name(INTERPRETATIONS).read_text(encoding="utf-8").rstrip(),
        "## Tables and figures",
        "`good ends`: fraction of the solves that end within 1 % of the best cost found in this run. `seeds: range`: "
        "number of training runs and the range of their means.",
    ]
    for section in sections:
        parts += [f"## {section.title}", *(paragraph for paragraph in section.body if paragraph)]
    parts += ["## Settings", f"```yaml\n{to_yaml(runner.config).strip()}\n```"]
    if seconds:
        wall, cpu = (sum(pair[k] for pair in seconds.values()) for k in (0, 1))
        cells = [(name, number(pair[0]), number(pair[1])) for name, pair in seconds.items()]
        parts += [
            "## Time",
            table(("table or figure", "s", "processor s"), [*cells, ("total", number(wall), number(cpu))]),
            f"Compilation is included. The program used {cpu / wall:.2f} processor cores on average"
            + ("; other programs slowed it down, so that all times are too long." if cpu < BUSY_CORES * wall else "."),
        ]
    return parts
