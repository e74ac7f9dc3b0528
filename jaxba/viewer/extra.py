"""viser, or an error that says how to install it. Needs the extra `view`."""

from __future__ import annotations

try:
    import viser
except ModuleNotFoundError:
    raise ImportError("this needs viser: pip install jaxba[view]") from None

__all__ = ["viser"]
