"""The floor in the images of one camera: how high it stands, how it is pitched and rolled."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from datasets.messages import Array
from fusion.calibration.blocks import DepthBlocks

POOL = 6000
"""Blocks of all images together that the floor is looked for in."""

TRIALS = 400
NEAR_SIGMA = 2.5
LEAST_SHARE = 0.02
"""Less than this of what the images show is no floor."""

HEIGHTS_M = (0.03, 3.0)
TILT_RAD = math.radians(30.0)
"""The guess of the camera's attitude may be wrong by this."""

ALONG_RAD = math.radians(25.0)
"""A block's own normal agrees with the floor's within this, or its noise."""


@dataclass(frozen=True, slots=True)
class Floor:
    """The plane of the floor in the optical frame.

    up_camera : (3,) unit, away from the floor. height_m : of the camera above it.
    share     : of the blocks looked at that lie on it.
    """

    up_camera: Array
    height_m: float
    share: float


def find_floor(images: list[DepthBlocks], up_camera_guess: Array) -> Floor | None:
    """The floor that all images show together, or None where they show none.

    up_camera_guess : (3,) unit, optical frame; wrong by up to ``TILT_RAD``.

    The camera is fixed to the base and the base stands on the floor: it is one plane in all images.
    RANSAC over the blocks of all of them, then least squares weighted by the noise. Of horizontal
    planes (floor, tables) the one is taken that has most on it and least below it.
    """
    pool = _pooled(images)
    facing = pool.normals @ up_camera_guess > math.cos(TILT_RAD + ALONG_RAD)
    candidates = np.flatnonzero(facing)
    if len(candidates) < 3:
        return None
    random = np.random.default_rng(np.random.SeedSequence(0))
    best, best_score = None, 0.0
    for _ in range(TRIALS):
        three = random.choice(candidates, size=3, replace=False)
        rays = pool.rays[three]
        if abs(np.linalg.det(rays)) < 1e-4:
            continue  # three blocks in a row
        plane = np.linalg.solve(rays, pool.inverse_depth[three])
        if not _possible(plane, up_camera_guess):
            continue
        score = _score(plane, pool, facing)
        if score > best_score:
            best, best_score = plane, score
    if best is None:
        return None
    plane, on_it = _refined(best, pool, facing)
    share = float(on_it.mean())
    if share < LEAST_SHARE or not _possible(plane, up_camera_guess):
        return None
    return Floor(-plane / np.linalg.norm(plane), 1.0 / float(np.linalg.norm(plane)), share)


def on_floor(
    blocks: DepthBlocks, up_camera: Array, height_m: float
) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Which blocks lie on the floor, (N,) bool, generously: 4 sigma, and with its normal."""
    off = blocks.rays @ (-up_camera / height_m) - blocks.inverse_depth
    upright = blocks.normals @ up_camera > math.cos(ALONG_RAD + math.radians(10.0))
    on_it: np.ndarray[tuple[int], np.dtype[np.bool_]] = upright & (np.abs(off) < 4.0 * blocks.sigma)
    return on_it


def _pooled(images: list[DepthBlocks]) -> DepthBlocks:
    """Evenly chosen blocks of all images, the same number of each."""
    each = max(1, POOL // max(1, len(images)))
    parts = [
        image.chosen(np.unique(np.linspace(0, len(image) - 1, each).astype(np.intp)))
        for image in images
        if len(image)
    ]
    if not parts:
        return DepthBlocks(np.empty((0, 3)), np.empty(0), np.empty(0), np.empty((0, 3)), 1.0)
    return DepthBlocks(
        np.concatenate([part.rays for part in parts]),
        np.concatenate([part.inverse_depth for part in parts]),
        np.concatenate([part.sigma for part in parts]),
        np.concatenate([part.normals for part in parts]),
        parts[0].focal_px,
    )


def _possible(plane: Array, up_camera_guess: Array) -> bool:
    size = float(np.linalg.norm(plane))
    if not 1.0 / HEIGHTS_M[1] < size < 1.0 / HEIGHTS_M[0]:
        return False
    return bool(-plane @ up_camera_guess > math.cos(TILT_RAD) * size)


def _score(
    plane: Array, pool: DepthBlocks, facing: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> float:
    """Blocks on the plane, minus those below it: nothing lies below the floor."""
    off = (pool.inverse_depth - pool.rays @ plane) / pool.sigma
    on_it = facing & (np.abs(off) < NEAR_SIGMA)
    # What is behind the plane as the camera sees it has a smaller inverse depth.
    below = (off < -2.0 * NEAR_SIGMA) & (pool.rays @ plane > 0.0)
    return float(on_it.sum()) - 2.0 * float(below.sum())


def _refined(
    plane: Array, pool: DepthBlocks, facing: np.ndarray[tuple[int], np.dtype[np.bool_]]
) -> tuple[Array, np.ndarray[tuple[int], np.dtype[np.bool_]]]:
    """Least squares over what lies on the plane, again and again; and what lies on it then."""
    on_it = np.zeros(len(pool), dtype=np.bool_)
    for _ in range(8):
        on_it = facing & (np.abs(pool.rays @ plane - pool.inverse_depth) < 3.0 * pool.sigma)
        if on_it.sum() < 3:
            break
        rays = pool.rays[on_it] / pool.sigma[on_it, None]
        plane = np.asarray(np.linalg.lstsq(rays, pool.inverse_depth[on_it] / pool.sigma[on_it])[0])
    return plane, on_it
