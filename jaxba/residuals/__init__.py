"""Residuals of one's own: registration, and ready-made ones."""

from jaxba.problem.residuals import residual
from jaxba.residuals.register import with_residual

__all__ = ["residual", "with_residual"]
