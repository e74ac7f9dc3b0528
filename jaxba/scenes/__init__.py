"""Random scenes that look like real bundle adjustment problems, of any size."""

from jaxba.scenes.config import LIKE, SceneConfig, Trajectory, like
from jaxba.scenes.generate import random_scene, random_scene_with_truth

__all__ = ["LIKE", "SceneConfig", "Trajectory", "like", "random_scene", "random_scene_with_truth"]
