"""The name of the game for `gymnasium.make`.

Since version 1.0 Gymnasium looks for no entry points: an environment is known once something
registers it. Its names are strings, so that nothing of the game is loaded here."""

from __future__ import annotations

import sys
from typing import Any

ID = "jaxba/BundleAdjustment-v0"
"""Name of the game."""

MAKERS = {
    "entry_point": "jaxba.training.api:gym_env",
    "vector_entry_point": "jaxba.training.api:gym_vector_env",
}
"""What makes it, one scene at a time or many."""


def register_game() -> None:
    """Registers the game where Gymnasium is loaded and does not know it."""
    gymnasium: Any = sys.modules.get("gymnasium")
    if hasattr(gymnasium, "register") and ID not in gymnasium.registry:
        gymnasium.register(ID, **MAKERS)
