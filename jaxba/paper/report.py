"""The report: claims, interpretations of the paper, all tables and settings in Markdown, and a page
of the figures."""

from __future__ import annotations

from pathlib import Path

from jaxba.bench import profile
from jaxba.bench.charts import AXES, problem_charts, profile_chart, solver_styles
from jaxba.bench.page import Page
from jaxba.bench.run import machine
from jaxba.paper import claims as rules
from jaxba.paper.agents import BEST, OURS, PRINTED, updates
from jaxba.paper.claims import Claim
from jaxba.paper.runner import Runner
from jaxba.paper.tables_and_figures import TABLES_AND_FIGURES
from jaxba.paper.tables_and_figures.common import TEXTS, table
from jaxba.paper.tables_and_figures.figures import FIGURES
from jaxba.runtime.atomic import write_text
from jaxba.settings import to_yaml

CLAIMS = "claims.md"  # file of the table of claims alone, in the folder of the run
TAU = 0.001  # the smaller tolerance of the paper's figures
# what the paper and its released code leave open, and what is done here
INTERPRETATIONS = "interpretations.md"


def write(runner: Runner, path: Path, command: str) -> list[Path]:
    """Writes the report, its table of claims, and the page of the figures if anything of them was
    run. The page stands beside the Markdown file, with the ending `.html`; `command` is the command
    line that made the report. Returns all files written. Raises OSError: a file cannot be
    written."""
    sections = [entry.section(runner) for entry in TABLES_AND_FIGURES.values()]
    claims = _claims(runner, [claim for _, own in sections for claim in own], command)
    rest = [
        Path(__file__).with_name(INTERPRETATIONS).read_text(encoding="utf-8").rstrip(),
        "## Tables and figures",
        "`good ends`: fraction of the solves that end within 1 % of the best cost found in this "
        "run. `seeds: range`: "
        "number of training runs and the range of their means.",
        *(paragraph for body, _ in sections for paragraph in body),
        f"## Settings\n\n```yaml\n{to_yaml(runner.config).strip()}\n```",
    ]
    files = [path, runner.folder / CLAIMS]
    if page := _figures(runner, command):
        files.append(path.with_suffix(".html"))
        write_text(files[-1], page)
        rest.insert(1, f"Figures: [{files[-1].name}]({files[-1].name}).")
    write_text(path, "\n\n".join([claims, *rest]) + "\n")
    write_text(runner.folder / CLAIMS, claims)
    return files


def _claims(runner: Runner, claims: list[Claim], command: str) -> str:
    """What the report begins with: how it was made, and the table of claims."""
    properties = machine()
    agents = runner.config.agents
    lengths = ", ".join(str(updates(runner.config, one)) for one in (PRINTED, OURS, BEST))
    tally = {
        status: sum(c.status == status for c in claims)
        for status in ("reproduced", "partly", "not", "not run")
    }
    cells = [(c.text, c.paper, c.ours, c.near, f"**{c.status}**") for c in claims]
    parts = [
        "# The paper, claim by claim",
        'Belder, Vivanti, Tal, "A Game of Bundle Adjustment - Learning Efficient Convergence", '
        "ICCV 2023, beside what jaxba measures. "
        f"This file is made by `{command}`; nothing in it is written by hand.",
        f"Machine: {properties['device']}, {properties['processor']}, Python "
        f"{properties['python']}, "
        f"JAX {properties['jax']}, jaxba {properties['jaxba']}. "
        f"Agents: {agents.seeds} training runs of each kind, all of which enter the tables, of "
        f"{lengths} updates (as "
        "printed, tuned, guarded). All arithmetic is in float64. An iteration is one linear solve, "
        "accepted or "
        "rejected. Means are arithmetic, as in the paper; **a failure counts as 100 iterations**.",
        "## Claims",
        "; ".join(f"{count} {status}" for status, count in tally.items()) + f" of {len(claims)}.",
        TEXTS["criterion"][2].format(
            ratio=rules.RATIO_TOLERANCE,
            partly=rules.PARTLY_RATIO,
            near=100 * rules.FRACTION_TOLERANCE,
            far=100 * rules.PARTLY_FRACTION_TOLERANCE,
        ),
        table(("claim", "paper", "ours", "to f\\*(1+1e-3)", "result"), cells).replace(
            "\\*\\*", "**"
        ),
    ]
    return "\n\n".join(parts) + "\n"


def _figures(runner: Runner, command: str) -> str:
    """The page of figures: profiles of several problems, convergence and lambdas of one. Empty if
    none was run."""
    drawn = {
        f"{figure.heading}: {part.problems.name}": records
        for figure in FIGURES
        for part in figure.parts(runner)
        if (records := part.records(runner))
    }
    styles = solver_styles(r.solver for records in drawn.values() for r in records)
    page = Page("The paper's figures", {"command": command}, styles, AXES)
    for title, records in drawn.items():
        first, *others = profile.problem_names(records)
        profiles = [
            profile_chart(records, target, styles) for target in profile.cost_targets(TAU) if others
        ]
        page.add(title, page.charts(profiles or problem_charts(records, first, TAU, styles)))
    return page.to_html() if drawn else ""
