"""Key-points of an image and their matches between two: SIFT, ratio test, mutual check, epipolar
geometry."""

from __future__ import annotations

import numpy as np
from jaxtyping import Float, Int

from jaxba.kitti.opencv import cv2

# contrast threshold, half of OpenCV's: asphalt and shadow have little contrast
SIFT_CONTRAST = 0.02
RATIO = 0.8  # largest ratio of the best to the second-best distance. Source: Lowe 2004, section 7.1
EPIPOLAR_PIXELS = 1.0  # distance from the epipolar line beyond which a match is an outlier
CONFIDENCE = 0.9999  # of the RANSAC for the essential matrix
MIN_ESSENTIAL = 8  # fewer matches cannot verify a geometry that five determine


def detect(
    image: np.ndarray, count: int
) -> tuple[Float[np.ndarray, "n 2"], Float[np.ndarray, "n 128"]]:
    """At most `count` key-points of a grey image, the strongest first, no two at the same place.
    Returns pixels relative to the centre of the first one, x to the right, y down; descriptors,
    integers as float32."""
    detector = cv2.SIFT.create(nfeatures=count, contrastThreshold=SIFT_CONTRAST)
    found, descriptors = detector.detectAndCompute(image, None)
    if not found:
        return np.empty((0, 2)), np.empty((0, 128), np.float32)
    pixels = np.array([key.pt for key in found], np.float64)
    response = np.array([key.response for key in found])
    # the order of detectors may depend on threads
    order = np.lexsort((pixels[:, 1], pixels[:, 0], -response))
    # SIFT repeats a key-point for every orientation
    _, unique = np.unique(pixels[order], axis=0, return_index=True)
    keep = order[np.sort(unique)][:count]
    return pixels[keep], np.asarray(descriptors)[keep]


def match(
    first: Float[np.ndarray, "n 128"], second: Float[np.ndarray, "k 128"]
) -> Int[np.ndarray, "m 2"]:
    """Descriptors of two images that are mutual nearest neighbours and pass the ratio test in both
    directions.

    Distances between integers below 2^24 are exact in float32."""
    if min(len(first), len(second)) < 2:
        return np.empty((0, 2), np.int64)
    squared = np.maximum(
        (first**2).sum(1)[:, None] + (second**2).sum(1) - 2 * (first @ second.T), 0
    )
    there = _nearest(squared)
    back = _nearest(squared.T)
    rows = np.flatnonzero((there >= 0) & (back[there] == np.arange(len(first))))
    return np.stack([rows, there[rows]], axis=1)


def _nearest(squared: np.ndarray) -> np.ndarray:
    """The column of the least entry of each row; -1 if the second least is about as small."""
    two = np.partition(squared, 1, axis=1)
    return np.where(two[:, 0] < RATIO**2 * two[:, 1], squared.argmin(axis=1), -1)


def essential(
    first: Float[np.ndarray, "m 2"], second: Float[np.ndarray, "m 2"], threshold: float
) -> tuple[np.ndarray | None, np.ndarray]:
    """Essential matrix of two views by the five-point method and OpenCV's most accurate RANSAC, and
    which of the rays `(X / Z, Y / Z)` are consistent with it: within this distance of the epipolar
    line, in units of the focal length.

    Source: Nister 2004, "An efficient solution to the five-point relative pose problem"; OpenCV's
    findEssentialMat."""
    if len(first) < MIN_ESSENTIAL:
        return None, np.zeros(len(first), bool)
    matrix, mask = cv2.findEssentialMat(
        np.ascontiguousarray(first),
        np.ascontiguousarray(second),
        np.eye(3),
        cv2.USAC_ACCURATE,
        CONFIDENCE,
        threshold,
    )
    if matrix is None or mask is None or matrix.shape[0] < 3:
        return None, np.zeros(len(first), bool)
    return np.asarray(matrix)[:3], np.asarray(mask).ravel() > 0
