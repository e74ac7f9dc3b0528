"""Random scenes that look like real bundle adjustment problems, of any size."""

from jaxba.scenes.config import DEFAULT_SCENES, LIKE, SceneConfig, Trajectory, scene_like
from jaxba.scenes.generate import random_scene, random_scene_with_truth
