"""Named things in a scene of viser, made once and changed afterwards: points, segments, frusta, a label."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from jaxtyping import Float

from jaxba.viewer.extra import viser

Colour = tuple[int, int, int]


class Layers:
    """What is drawn under one name in the tree of a scene. The first word of a thing's name is its layer."""

    def __init__(self, server: viser.ViserServer, root: str, position: tuple[float, float, float]) -> None:
        self._scene, self._root = server.scene, root
        self._nodes: dict[str, Any] = {}
        self.frusta: dict[int, Any] = {}
        server.scene.add_frame(root, show_axes=False, position=position)

    def __contains__(self, name: str) -> bool:
        return name in self._nodes

    def show(self, layer: str, visible: bool) -> None:
        """Shows or hides a layer."""
        for name, node in self._nodes.items():
            if name.split()[0] == layer:
                node.visible = visible

    def size(self, name: str, size: float) -> None:
        """Draws points in another size."""
        self._nodes[name].point_size = size

    def remove(self, layer: str) -> None:
        """Removes a layer."""
        for name in [name for name in self._nodes if name.split()[0] == layer]:
            self._nodes.pop(name).remove()

    def cloud(self, name: str, points: Float[np.ndarray, "n 3"], colours: Any, size: float) -> None:
        """Draws points, in one colour or one for each; what is not finite lies at the origin."""
        points = np.nan_to_num(points, nan=0.0, posinf=0.0, neginf=0.0).astype(np.float32)
        colours, node = np.asarray(colours, np.uint8), self._nodes.get(name)
        if node is not None and len(node.points) == len(points):
            node.points, node.colors = points, colours
            return
        looks: dict[str, Any] = {"point_shape": "circle", "point_shading": "flat", "precision": "float32"}
        self._nodes[name] = self._scene.add_point_cloud(
            f"{self._root}/{name}", points, colours, point_size=size, **looks
        )

    def lines(self, name: str, segments: Float[np.ndarray, "n 2 3"], colour: Colour, width: float) -> None:
        """Draws segments, `width` pixels wide."""
        self._nodes[name] = self._scene.add_line_segments(
            f"{self._root}/{name}", segments, colour, thickness=width, thickness_units="screen"
        )

    def label(self, text: str, position: tuple[float, float, float]) -> None:
        """Writes a text; its first position stays."""
        if "label" in self._nodes:
            self._nodes["label"].text = text
            return
        self._nodes["label"] = self._scene.add_label(
            f"{self._root}/label", text, position=position, anchor="bottom-center"
        )

    def frustum(
        self,
        camera: int,
        pose: Float[np.ndarray, "3 4"],
        half: Float[np.ndarray, "2"],
        scale: float,
        colour: Colour,
        on_click: Callable[[int], None] | None,
    ) -> None:
        """Draws a camera, whose camera-to-world pose looks along +z with y downwards. Half of its image's width and
        height at distance 1 and viser's scale stay those of the first call. A click calls `on_click` with it."""
        from scipy.spatial.transform import Rotation

        quaternion = Rotation.from_matrix(pose[:, :3]).as_quat()[[3, 0, 1, 2]]
        handle = self.frusta.get(camera)
        if handle is not None:
            handle.wxyz, handle.position = quaternion, pose[:, 3]
            if handle.color != colour:
                handle.color = colour
            return
        handle = self.frusta[camera] = self._scene.add_camera_frustum(
            f"{self._root}/cameras/{camera}",
            fov=2 * float(np.arctan(half[1])),
            aspect=float(half[0] / half[1]),
            scale=scale,
            thickness=1.5,
            thickness_units="screen",
            color=colour,
            wxyz=quaternion,
            position=pose[:, 3],
            cast_shadow=False,
            receive_shadow=False,
        )
        if on_click is not None:
            handle.on_click(lambda _: on_click(camera))
