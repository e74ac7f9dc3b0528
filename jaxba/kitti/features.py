"""Key-points of an image and their matches between two: SIFT or ORB, ratio test, mutual check, epipolar geometry."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from jaxba.io.frames import Calibration
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
    descriptors: np.ndarray  # uint8, [n, 128] (SIFT) or [n, 32] (ORB, bits)


class Verified(NamedTuple):
    """Matches of two images that are consistent with one motion of the camera."""

    first: Int[np.ndarray, " m"]  # key-points of the first image
    second: Int[np.ndarray, " m"]


def detect(image: np.ndarray, features: Features, count: int) -> KeyPoints:
    """At most `count` key-points of a grey image, no two at the same place.

    Args:
        image: shape (height, width), uint8.
        features: `sift` or `orb`.
        count: the strongest ones are kept.
    """
    none = KeyPoints(np.empty((0, 2)), np.empty((0, 128 if features == "sift" else 32), np.uint8))
    if features == "sift":
        detector = cv2.SIFT.create(nfeatures=count, contrastThreshold=SIFT_CONTRAST)
    elif min(image.shape) <= 2 * ORB_BORDER:
        return none
    else:
        detector = cv2.ORB.create(nfeatures=count, fastThreshold=ORB_FAST, edgeThreshold=ORB_BORDER)
    found, descriptors = detector.detectAndCompute(image, None)
    if descriptors is None or not found:
        return none
    pixels = np.array([key.pt for key in found], np.float64)
    response = np.array([key.response for key in found])
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -response))  # the order of detectors may depend on threads
    _, unique = np.unique(pixels[order], axis=0, return_index=True)  # SIFT repeats a key-point for every orientation
    keep = order[np.sort(unique)][:count]
    return KeyPoints(pixels[keep], np.asarray(descriptors)[keep].astype(np.uint8))


def match(first: KeyPoints, second: KeyPoints) -> Int[np.ndarray, "m 2"]:
    """Mutual nearest neighbours that pass the ratio test in both directions.

    Distances are Euclidean (SIFT, 128 numbers) or Hamming (ORB, 256 bits). All numbers are integers below 2^24, so
    float32 is exact and the order of summation does not matter.
    """
    if len(first.pixels) < 2 or len(second.pixels) < 2:
        return np.empty((0, 2), np.int64)
    a, b = _vectors(first.descriptors), _vectors(second.descriptors)
    squared = np.maximum((a * a).sum(1)[:, None] + (b * b).sum(1) - 2 * (a @ b.T), 0)
    binary = first.descriptors.shape[1] == 32  # squared distance of bits is already the Hamming distance
    limit = RATIO if binary else RATIO**2
    forward, backward = squared.argmin(axis=1), squared.argmin(axis=0)
    rows = np.flatnonzero(backward[forward] == np.arange(len(a)))
    columns = forward[rows]
    best = squared[rows, columns]
    clear = np.ones(len(rows), bool)
    for table, own in ((squared[rows], columns), (squared.T[columns], rows)):
        others = table.copy()
        others[np.arange(len(rows)), own] = np.inf
        clear &= best < limit * others.min(axis=1)
    return np.stack([rows[clear], columns[clear]], axis=1)


def epipolar_inliers(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], calibration: Calibration, seed: int
) -> np.ndarray:
    """Which matched pixels are consistent with one essential matrix, shape (m,), by RANSAC.

    Distances are measured in rays, in which both axes have the same scale.
    """
    if len(first) < MIN_ESSENTIAL:
        return np.zeros(len(first), bool)
    _, inliers = essential(calibration.rays(first), calibration.rays(second), EPIPOLAR_PIXELS / calibration.fx, seed)
    return inliers


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
    cv2.setRNGSeed(seed)
    matrix, mask = cv2.findEssentialMat(
        np.ascontiguousarray(first), np.ascontiguousarray(second), np.eye(3), cv2.RANSAC, CONFIDENCE, threshold
    )
    if matrix is None or mask is None or matrix.shape[0] < 3:
        return None, np.zeros(len(first), bool)
    return np.asarray(matrix)[:3], np.asarray(mask).ravel() > 0


def _vectors(descriptors: np.ndarray) -> np.ndarray:
    if descriptors.shape[1] == 32:
        return np.unpackbits(descriptors, axis=1).astype(np.float32)
    return descriptors.astype(np.float32)
