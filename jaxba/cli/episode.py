"""`jaxba-view` with episodes of the game, which are recorded here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from jaxba.cli import common, view

if TYPE_CHECKING:
    from jaxba.viewer.recording import Recording

LARGEST_EPISODE = 40
"""Most iterations of an episode: those of the training presets."""


def main() -> None:
    """Entry point of `jaxba-view`."""
    common.exit_with(run())


def run(argv: Sequence[str] | None = None) -> int:
    """Runs the command, as `view.run`."""
    return view.run(argv, recorded)


def recorded(policy: str, scene: int) -> Recording:
    """An episode on a scene of the game's default class.

    Args:
        policy: name or file.
        scene: number of the random scene.
    """
    import jax
    import numpy as np

    import jaxba
    from jaxba.game.episode import draw
    from jaxba.game.random_scenes import SceneClass
    from jaxba.viewer.recording import Recording

    jax.config.update("jax_enable_x64", True)  # the game's type
    player = jaxba.make_policy(policy)
    played = draw(SceneClass(), jax.random.key(0), scene, player, jaxba.trained_step(player), LARGEST_EPISODE)
    start = np.array([np.nan])
    return Recording(
        problem=played.problem,
        whole=played.problem.num_points,
        cameras=played.cameras,
        points=played.points,
        state=np.arange(len(played.cost)),
        cost=played.cost,
        damping=np.concatenate([start, played.damping]),
        gain_ratio=np.concatenate([start, played.gain_ratio]),
        time_s=played.paid,
        unit="plain steps paid",
    )
