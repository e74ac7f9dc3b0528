"""The tables and figures of the paper, one module each."""

from jaxba.paper.tables_and_figures import (
    bal,
    constant_schedule,
    convergence,
    kitti,
    lambda_chart,
    profiles,
    reversed_roles,
    rewards,
    small,
    state_size,
    sub_problems,
    synthetic,
    zero,
)
from jaxba.paper.tables_and_figures.common import TableOrFigure

TABLES_AND_FIGURES: dict[str, TableOrFigure] = {
    module.ENTRY.name: module.ENTRY
    for module in (
        kitti,
        bal,
        synthetic,
        sub_problems,
        zero,
        state_size,
        reversed_roles,
        rewards,
        constant_schedule,
        small,
        lambda_chart,
        profiles,
        convergence,
    )
}
"""Tables and figures by name, in the order of the paper."""

__all__ = ["TABLES_AND_FIGURES", "TableOrFigure"]
