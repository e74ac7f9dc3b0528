"""`python -m jaxba COMMAND ...`: the commands, where their scripts are not on the path."""

from __future__ import annotations

import importlib
import sys

COMMANDS = {
    "solve": "bundle adjustment of a problem, or of several",
    "view": "look at a problem or at a recorded solve in the browser",
    "bench": "compare solvers on problems, with performance profiles",
    "train": "train an agent that chooses the damping",
    "kitti": "make a problem of a sequence of KITTI, or evaluate one",
    "data": "download problems of BAL",
    "paper": "the tables and figures of the paper",
}
"""What the commands do, by name."""


def main() -> None:
    """Runs the command that is named first."""
    name = sys.argv[1] if len(sys.argv) > 1 else ""
    if name not in COMMANDS:
        print("usage: python -m jaxba COMMAND ...\n\ncommands:")
        for command, text in COMMANDS.items():
            print(f"  {command:8}{text}")
        sys.exit(0 if name in ("", "-h", "--help") else 2)
    sys.argv = [f"jaxba-{name}", *sys.argv[2:]]
    importlib.import_module(f"jaxba.cli.{name}").main()


if __name__ == "__main__":
    main()
