"""A block of a drone: images in strips that look down on hills, surveyed points, and the files of
all that."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pyproj

import jaxba
from jaxba.problem import geometry
from jaxba.problem.similarity import Similarity, transformed

ORIGIN = (8.5, 47.3, 500.0)
"""Longitude, latitude and height of the origin."""

HEIGHT = 100.0
STRIPS = 6
PER_STRIP = 10
POINTS = 800
LENS = (1000.0, -0.05, 0.0)  # f (pixels), k1, k2
RTK, SURVEYED, CLICKED = 0.02, 0.01, 0.5  # standard deviations: metres, metres, pixels
SIZE = np.array([1000, 750])  # pixels
CONTROLS = 5
CHECKS = 20
"""Marks of each kind; the first ones are control points."""


class Block(NamedTuple):
    """Files of a block, and what is true, metres east, north and up of the origin."""

    folder: Path
    truth: jaxba.BundleProblem
    marks: np.ndarray


def on_earth(places: np.ndarray, crs: str = "EPSG:4979") -> np.ndarray:
    """Longitude, latitude and height, or other coordinates, of metres east, north and up of
    `ORIGIN`."""
    lon, lat, height = ORIGIN
    pipeline = (
        f"+proj=pipeline +step +inv +proj=topocentric +ellps=WGS84 +lon_0={lon} +lat_0={lat} "
        f"+h_0={height} "
        "+step +inv +proj=cart +ellps=WGS84 +step +proj=unitconvert +xy_in=rad +xy_out=deg"
    )
    found = pyproj.Transformer.from_pipeline(pipeline).transform(*places.T)
    target = pyproj.CRS(crs).to_3d()
    return np.stack(
        pyproj.Transformer.from_crs("EPSG:4979", target, always_xy=True).transform(*found), axis=1
    )


def drone_block(folder: Path, seed: int = 0) -> Block:
    """Writes `model`, a start in a frame of its own, `log.csv`, `gcp_list.txt` and `c.yaml`."""
    rng = np.random.default_rng(seed)
    along, across = np.meshgrid(np.arange(PER_STRIP) * 20.0, np.arange(STRIPS) * 30.0)
    centers = np.stack(
        [along.ravel(), across.ravel(), HEIGHT + rng.normal(0, 1, along.size)], axis=1
    )
    turns = rng.normal(0, 0.03, centers.shape)
    turns[:, 2] += np.repeat(np.arange(STRIPS) % 2 * np.pi, PER_STRIP)  # there and back
    area = np.array([[-30, -20], [PER_STRIP * 20 + 10, STRIPS * 30 - 10]])
    places = np.column_stack([rng.uniform(*area, (POINTS, 2)), np.zeros(POINTS)])
    marks = np.column_stack(
        [rng.uniform(*(area * 0.9 + 5), (CONTROLS + CHECKS, 2)), np.zeros(CONTROLS + CHECKS)]
    )
    for one in (places, marks):
        one[:, 2] = 8 * np.sin(one[:, 0] / 30) * np.cos(one[:, 1] / 40) + rng.normal(0, 1, len(one))
    cameras = _cameras(turns, centers, *LENS)
    lenses = jaxba.Lenses(np.zeros(len(cameras), np.int32), np.array([[True, True, False]]))
    pairs = np.stack(
        np.meshgrid(np.arange(len(cameras)), np.arange(POINTS + len(marks))), axis=-1
    ).reshape(-1, 2)
    every = jaxba.BundleProblem.create(
        cameras, np.vstack([places, marks]), np.zeros(pairs.shape), *pairs.T
    )
    pixels = geometry.project(every)
    inside = (np.abs(pixels) < SIZE / 2).all(axis=1)
    tie = inside & (pairs[:, 1] < POINTS)
    mark = inside & (pairs[:, 1] >= POINTS)
    noisy = pixels + rng.normal(0, np.where(tie, 1.0, CLICKED)[:, None], pixels.shape)
    truth = jaxba.BundleProblem.create(cameras, places, noisy[tie], *pairs[tie].T, lenses=lenses)
    moved = turns + rng.normal(0, 0.003, turns.shape), centers + rng.normal(0, 0.3, centers.shape)
    start = _cameras(*moved, 1.02 * LENS[0], 0.0, 0.0)
    start = truth.replace(cameras=start, points=places + rng.normal(0, 0.3, places.shape))
    (turn,) = geometry.rotation_matrices(np.array([[0.4, -0.7, 1.1]]))
    jaxba.write_colmap(
        transformed(start, Similarity(0.05, turn, np.array([3.0, -1.0, 2.0]))), folder / "model"
    )
    middle = np.ceil(np.abs(noisy[tie]).max(axis=0))  # as `write_colmap` makes it up
    names = [f"image{one + 1:04d}.jpg" for one in range(len(cameras))]
    log = on_earth(centers + rng.normal(0, RTK, centers.shape)).tolist()
    lines = [
        f"{name},{lat!r},{lon!r},{up!r},{RTK}"
        for name, (lon, lat, up) in zip(names, log, strict=True)
    ]
    (folder / "log.csv").write_text(
        "\n".join(["image,latitude,longitude,altitude,accuracy", *lines, ""])
    )
    measured = marks + rng.normal(0, SURVEYED, marks.shape)
    measured[CONTROLS:] = marks[CONTROLS:]
    grid = on_earth(measured, "EPSG:32632").tolist()
    lines = ["WGS84 UTM 32N"]
    for (image, at), (x, y) in zip(pairs[mark].tolist(), noisy[mark].tolist(), strict=True):
        east, north, up = grid[at - POINTS]
        lines.append(
            f"{east!r} {north!r} {up!r} {middle[0] + x} {middle[1] - y} {names[image]} "
            f"gcp{at - POINTS}"
        )
    (folder / "gcp_list.txt").write_text("\n".join([*lines, ""]))
    checks = ", ".join(f"gcp{one}" for one in range(CONTROLS, CONTROLS + CHECKS))
    (folder / "c.yaml").write_text(
        "position_priors: {file: log.csv}\n"
        f"control_points: {{file: gcp_list.txt, stddev: {SURVEYED}, pixels: {CLICKED}, check: "
        f"[{checks}]}}\n"
    )
    return Block(folder, truth, marks)


def _cameras(turns: np.ndarray, centers: np.ndarray, *lens: float) -> np.ndarray:
    shift = -np.einsum("nij,nj->ni", geometry.rotation_matrices(turns), centers)
    return np.hstack([turns, shift, np.tile(lens, (len(centers), 1))])
