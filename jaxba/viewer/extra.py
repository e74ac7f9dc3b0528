"""viser, or an error that says how to install it. Needs the extra `view`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

try:
    import rich
    import viser
except ModuleNotFoundError:
    raise ImportError("this needs viser: pip install jaxba[view]") from None

__all__ = ["HOST", "quietly", "viser"]

HOST = "127.0.0.1"  # address under which only this machine reaches the page


def quietly(act: Callable[..., Any], **options: Any) -> Any:
    """Lets viser's server act without its words."""
    console = rich.get_console()
    before = console.quiet
    console.quiet = True
    try:
        return act(**options)
    finally:
        console.quiet = before
