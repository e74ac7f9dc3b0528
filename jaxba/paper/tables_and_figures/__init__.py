"""The tables and figures of the paper."""

from jaxba.paper.tables_and_figures import ablations, figures, real
from jaxba.paper.tables_and_figures.common import Table

TABLES_AND_FIGURES: dict[str, Table] = {  # tables and figures by name, in the order of the paper
    entry.name: entry
    for entry in (*real.TABLES, *ablations.TABLES, figures.SMALL, *figures.FIGURES)
}
