"""The tables and figures of the paper."""

from jaxba.paper.tables_and_figures import ablations, figures, real, small
from jaxba.paper.tables_and_figures.common import TableOrFigure

TABLES_AND_FIGURES: dict[str, TableOrFigure] = {
    entry.name: entry
    for entry in (
        *(real.KITTI, real.BAL, real.SYNTHETIC, real.FAMILIES),
        *ablations.TABLES,
        *(small.SMALL, figures.LAMBDA, figures.PROFILES, figures.CONVERGENCE),
    )
}
"""Tables and figures by name, in the order of the paper."""

__all__ = ["TABLES_AND_FIGURES", "TableOrFigure"]
