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

    import jaxba
    from jaxba.game.random_scenes import SceneClass
    from jaxba.game.scene_bank import draw
    from jaxba.viewer.recording import Recorder

    jax.config.update("jax_enable_x64", True)  # the game's type
    problem = draw(SceneClass(), jax.random.key(0), scene)
    recorder = Recorder(problem)
    options = jaxba.SolveOptions(max_iterations=LARGEST_EPISODE)
    jaxba.solve(problem, jaxba.make_policy(policy), options, watch=recorder)
    return recorder.recording()
