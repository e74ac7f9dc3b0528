"""Key-points of an image and their matches between two: SIFT or ORB, ratio test, mutual check, epipolar geometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.kitti.opencv import cv2
from jaxba.kitti.options import Features

SIFT_CONTRAST = 0.02
"""Contrast threshold, half of OpenCV's: asphalt and shadow have little contrast."""

ORB_FAST = 10
"""FAST threshold in grey levels, half of OpenCV's, for the same reason."""

RATIO = 0.8
"""Largest ratio of the best to the second-best distance. Source: Lowe 2004, section 7.1."""

EPIPOLAR_PIXELS = 1.0
"""Distance from the epipolar line beyond which a match is an outlier."""

CONFIDENCE = 0.9999
"""Of the RANSAC for the essential matrix."""

ORB_BORDER = 31
"""OpenCV finds nothing nearer to the border, and fails on images too small for its pyramid (`edgeThreshold`)."""

MIN_ESSENTIAL = 8
"""Fewer matches cannot verify a geometry that five determine."""


class KeyPoints(NamedTuple):
    """Key-points of an image, the strongest first."""

    pixels: Float[np.ndarray, "n 2"]  # relative to the centre of the first pixel, x to the right, y down
    descriptors: np.ndarray  # float32 [n, 128] (SIFT) or uint8 [n, 32] (ORB, bits)


def detect(image: np.ndarray, features: Features, count: int) -> KeyPoints:
    """At most `count` key-points of a grey image, no two at the same place.

    Args:
        image: shape (height, width), uint8.
        features: `sift` or `orb`.
        count: the strongest ones are kept.
    """
    found, descriptors = (), None
    if features == "sift":
        detector = cv2.SIFT.create(nfeatures=count, contrastThreshold=SIFT_CONTRAST)
        found, descriptors = detector.detectAndCompute(image, None)
    elif min(image.shape) > 2 * ORB_BORDER:
        detector = cv2.ORB.create(nfeatures=count, fastThreshold=ORB_FAST, edgeThreshold=ORB_BORDER)
        found, descriptors = detector.detectAndCompute(image, None)
    if not found:
        return KeyPoints(np.empty((0, 2)), np.empty((0, 32), np.uint8))
    pixels = np.array([key.pt for key in found], np.float64)
    response = np.array([key.response for key in found])
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -response))  # the order of detectors may depend on threads
    _, unique = np.unique(pixels[order], axis=0, return_index=True)  # SIFT repeats a key-point for every orientation
    keep = order[np.sort(unique)][:count]
    return KeyPoints(pixels[keep], np.asarray(descriptors)[keep])


def match(first: KeyPoints, second: KeyPoints) -> Int[np.ndarray, "m 2"]:
    """Mutual nearest neighbours that pass the ratio test in both directions, sorted.

    Distances are Euclidean (SIFT, 128 integers) or Hamming (ORB, 256 bits): exact in float32.
    """
    if min(len(first.pixels), len(second.pixels)) < 2:
        return np.empty((0, 2), np.int64)
    binary = first.descriptors.shape[1] == 32  # the squared distance of bits is the Hamming distance
    a, b = ((np.unpackbits(x, axis=1) if binary else x).astype(np.float32) for x in (first[1], second[1]))
    squared = np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * (a @ b.T), 0)
    there, back = (_nearest(table, RATIO if binary else RATIO**2) for table in (squared, squared.T))
    rows = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(a))))
    return np.stack([rows, there[rows]], axis=1)


def _nearest(distances: np.ndarray, ratio: float) -> np.ndarray:
    """The column of the least entry of each row; -1 if the second least is about as small."""
    two = np.partition(distances, 1, axis=1)
    return np.where(two[:, 0] < ratio * two[:, 1], distances.argmin(axis=1), -1)


def essential(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], threshold: float, seed: int
) -> tuple[np.ndarray | None, np.ndarray]:
    """Essential matrix of two views by the five-point method and RANSAC, and which rays are consistent with it.

    Args:
        first: rays `(X / Z, Y / Z)` in the first view.
        second: the same in the second view.
        threshold: distance from the epipolar line, in units of the focal length.
        seed: of the samples.

    Source: Nister 2004, "An efficient solution to the five-point relative pose problem"; OpenCV's findEssentialMat.
    """
    if len(first) < MIN_ESSENTIAL:
        return None, np.zeros(len(first), bool)
    cv2.setRNGSeed(seed)
    matrix, mask = cv2.findEssentialMat(
        np.ascontiguousarray(first), np.ascontiguousarray(second), np.eye(3), cv2.USAC_ACCURATE, CONFIDENCE, threshold
    )
    if matrix is None or mask is None or matrix.shape[0] < 3:
        return None, np.zeros(len(first), bool)
    return np.asarray(matrix)[:3], np.asarray(mask).ravel() > 0
