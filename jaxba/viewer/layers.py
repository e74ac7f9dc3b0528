"""Named things in a scene of viser, made once and changed afterwards: points, segments, frusta, a
label."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.viewer.extra import viser

# with the number of an image, and the event
Clicked = Callable[[int, viser.SceneNodePointerEvent], None] | None


class Layers:
    """What is drawn under one name in the tree of a scene. The first word of a thing's name is its
    layer."""

    def __init__(
        self, server: viser.ViserServer, root: str, position: tuple[float, float, float]
    ) -> None:
        self._scene = server.scene
        self._root = root
        self._nodes: dict[str, Any] = {}
        self.frusta: dict[int, Any] = {}
        server.scene.add_frame(root, show_axes=False, position=position)

    def remove(self, layer: str) -> None:
        """Removes a layer."""
        for name in [name for name in self._nodes if name.split()[0] == layer]:
            self._nodes.pop(name).remove()

    def cloud(self, name: str, points: Float[np.ndarray, "n 3"], colours: Any, size: float) -> None:
        """Draws points, in one colour or one for each; what is not finite lies at the origin."""
        points = np.nan_to_num(points, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
        colours = np.asarray(colours, np.uint8)
        node = self._nodes.get(name)
        if node is not None and len(node.points) == len(points):
            node.points = points
            node.colors = colours
            node.point_size = size
            return
        looks: dict[str, Any] = {
            "point_shape": "circle",
            "point_shading": "flat",
            "precision": "float32",
        }
        place = f"{self._root}/{name}"
        self._nodes[name] = self._scene.add_point_cloud(
            place, points, colours, point_size=size, **looks
        )

    def lines(
        self, name: str, segments: Float[np.ndarray, "n 2 3"], colour: Any, width: float
    ) -> None:
        """Draws segments, `width` pixels wide, in one colour or one for each end."""
        self._nodes[name] = self._scene.add_line_segments(
            f"{self._root}/{name}", segments, colour, thickness=width, thickness_units="screen"
        )

    def label(
        self, name: str, text: str, position: tuple[float, float, float], under: str = ""
    ) -> None:
        """Writes a text, which moves with the frustum that it stands under."""
        node = self._scene.add_label(
            f"{self._root}/{under}{name}", text, position=position, anchor="bottom-center"
        )
        self._nodes[name] = node

    def frustum(
        self,
        camera: int,
        pose: np.ndarray,
        half: np.ndarray,
        scale: float,
        colour: tuple[int, ...],
        clicked: Clicked,
    ) -> None:
        """Draws a camera, whose camera-to-world pose looks along +z with y downwards. Half of its
        image's width and height at distance 1 stay those of the first call."""
        from scipy.spatial.transform import Rotation

        quaternion = Rotation.from_matrix(pose[:, :3]).as_quat()[[3, 0, 1, 2]]
        handle = self.frusta.get(camera)
        if handle is not None:
            handle.wxyz = quaternion
            handle.position = pose[:, 3]
            handle.scale = scale
            if handle.color != colour:
                handle.color = colour
            return
        name = f"{self._root}/cameras/{camera}"
        size = {"fov": 2 * float(np.arctan(half[1])), "scale": scale}
        looks: Any = {
            "thickness": 1.5,
            "thickness_units": "screen",
            "cast_shadow": False,
            "receive_shadow": False,
        }
        place: Any = {
            "aspect": float(half[0] / half[1]),
            "color": colour,
            "wxyz": quaternion,
            "position": pose[:, 3],
        }
        handle = self.frusta[camera] = self._scene.add_camera_frustum(
            name, **size, **place, **looks
        )
        if clicked is not None:
            handle.on_click(lambda event: clicked(camera, event))
