"""The rows of a run's log for Weights & Biases, with the extra `wandb`."""

from __future__ import annotations

import secrets
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from jaxba.training.driver import TrainError
from jaxba.training.log import ORDER, Row

RUN = "wandb-run.txt"
"""File with the id of the run, so that a resumed run goes on there."""


class WandbLog:
    """A run at Weights & Biases. `WANDB_MODE=offline` keeps it in the folder."""

    def __init__(self, project: str, folder: Path, config: Mapping[str, Any]) -> None:
        """Begins a run, or goes on with the one of the folder.

        Args:
            project: its name there.
            folder: of the training run, which has the name of the run.
            config: shown there.

        Raises:
            TrainError: the package is missing, or the run cannot be begun.
            OSError: the folder cannot be written.
        """
        try:
            import wandb
            from wandb.errors import Error
        except ImportError:
            raise TrainError("--wandb needs the package wandb: pip install 'jaxba[wandb]'") from None
        path = folder / RUN
        number = path.read_text().strip() if path.is_file() else secrets.token_hex(4)
        try:
            self._run = wandb.init(
                project=project, name=folder.name, id=number, resume="allow", dir=str(folder), config=dict(config)
            )
        except Error as error:
            raise TrainError(f"--wandb {project}: {' '.join(str(error).split())}") from None
        path.write_text(number + "\n")

    def write(self, rows: Sequence[Row]) -> None:
        """Logs a chunk: means over the agents, and those of each agent if there are several."""
        self._run.log(chunk_values(rows), step=rows[0]["chunk"])

    def close(self) -> None:
        """Ends the run."""
        self._run.finish()


def chunk_values(rows: Sequence[Row]) -> dict[str, float]:
    """Means over agents of the numbers of a chunk, and as `seedK/NAME` those of each agent if there are several."""
    found: dict[str, float] = {}
    for name in rows[0]:
        values = {row["seed"]: row[name] for row in rows if isinstance(row.get(name), int | float)}
        if name in ORDER[:2] or not values:
            continue
        found[name] = sum(values.values()) / len(values)
        if len(rows) > 1:
            found |= {f"seed{seed}/{name}": value for seed, value in values.items()}
    return found
