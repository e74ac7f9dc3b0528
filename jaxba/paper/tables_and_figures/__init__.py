"""One module per table or figure of the paper, in its order."""

from jaxba.paper.pieces import (
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
from jaxba.paper.pieces.base import Piece

PIECES: dict[str, Piece] = {
    module.PIECE.name: module.PIECE
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

__all__ = ["PIECES", "Piece"]
