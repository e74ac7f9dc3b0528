"""The folder of this package within the user's cache folder."""

from __future__ import annotations

import os
from pathlib import Path


def user_cache(part: str) -> Path:
    """A folder of this package within the user's cache folder, as the XDG base directory specification has it."""
    base = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(base) / "jaxba" / part
