"""A street rendered by casting rays: a small KITTI sequence whose poses and geometry are known
exactly.

Four textured planes (ground, two walls, a far wall) stand in KITTI's axes: x right, y down, z
forward. No code of jaxba takes part, so what is found in the images can be compared with how they
were made."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.spatial.transform import Rotation

cv2 = pytest.importorskip("cv2", reason="the extra kitti is not installed")

TEXEL = 0.03
"""Metres."""

PLANES = (  # normal axis, position along it, axes of the texture
    (1, 1.5, (0, 2)),
    (0, -4.0, (1, 2)),
    (0, 5.0, (1, 2)),
    (2, 26.0, (0, 1)),
)


@dataclass(frozen=True)
class Camera:
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float


SMALL = Camera(320, 160, 210.0, 210.0, 155.3, 84.6)
OTHER = Camera(400, 210, 260.0, 250.0, 204.0, 99.5)


def textures() -> list[np.ndarray]:
    random = np.random.default_rng(7)
    layers = []
    for _ in PLANES:
        noise = sum(
            amount
            * gaussian_filter(random.standard_normal((1024, 1024)), sigma, mode="wrap")
            * sigma
            for sigma, amount in ((1.2, 1.0), (4.0, 1.0), (12.0, 0.7))
        )
        layers.append(np.clip(128 + 60 * noise / np.std(noise), 0, 255))
    return layers


def render(camera: Camera, pose: np.ndarray, layers: list[np.ndarray]) -> np.ndarray:
    """The image seen from a camera-to-world pose [3, 4]: four rays a pixel, the nearest plane in
    front of each."""
    half = np.array([-0.25, 0.25])
    u = (np.arange(camera.width)[:, None] + half).ravel()
    v = (np.arange(camera.height)[:, None] + half).ravel()
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ pose[:, :3].T
    nearest = np.full(x.shape, np.inf)
    grey = np.zeros(x.shape)
    for (axis, position, (a, b)), layer in zip(PLANES, layers, strict=True):
        with np.errstate(divide="ignore"):
            distance = (position - pose[axis, 3]) / rays[..., axis]
        hit = (distance > 0) & (distance < nearest)
        places = pose[:, 3] + rays[hit] * distance[hit][:, None]
        grey[hit] = map_coordinates(
            layer, [places[:, a] / TEXEL, places[:, b] / TEXEL], order=1, mode="grid-wrap"
        )
        nearest[hit] = distance[hit]
    fine = grey.reshape(camera.height, 2, camera.width, 2)
    return np.rint(fine.mean(axis=(1, 3))).astype(np.uint8)


def path(count: int, step: float = 0.4) -> np.ndarray:
    """Camera-to-world poses of a gentle bend."""
    angles = np.deg2rad(1.2) * np.arange(count)
    rotation = Rotation.from_rotvec(angles[:, None] * [0.0, 1.0, 0.0]).as_matrix()
    centers = np.zeros((count, 3))
    centers[1:] = np.cumsum(step * rotation[:-1, :, 2], axis=0)
    centers[:, 1] += 0.02 * np.sin(np.arange(count))
    return np.concatenate([rotation, centers[:, :, None]], axis=2)


def write_sequence(folder: Path, camera: Camera, poses: np.ndarray) -> Path:
    """Renders a sequence folder and its `poses.txt`; returns the folder."""
    (folder / "image_0").mkdir(parents=True)
    layers = textures()
    for number, pose in enumerate(poses):
        cv2.imwrite(str(folder / "image_0" / f"{number:06d}.png"), render(camera, pose, layers))
    matrix = [camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0]
    (folder / "calib.txt").write_text(
        "P0: " + " ".join(f"{number:.12e}" for number in matrix) + "\n"
    )
    rows = [" ".join(f"{number:.9e}" for number in pose.ravel()) for pose in poses]
    (folder / "poses.txt").write_text("\n".join(rows) + "\n")
    return folder
