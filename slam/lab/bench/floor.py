"""Real images of bare floor, outlined by hand: how many beams take it for an obstacle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import yaml

from datasets.errors import InputError
from datasets.messages import Array, DepthImage, Float32s
from datasets.recording import CameraCalibration, Intrinsics
from fusion.depth_config import DepthConfig
from fusion.depth_labels import FREE, NEAREST
from fusion.depth_projection import DepthProjection

K_D435 = np.array([[383.8, 0.0, 321.7], [0.0, 383.8, 236.8], [0.0, 0.0, 1.0]])
"""Of the images in data/depth/d435."""
HEIGHTS_M = (0.4, 0.9)
"""Between these it was held."""

Outline = Sequence[tuple[int, int]]

POINTS = 20000
TRIALS = 400
NOISE_M, NOISE_PER_M = 0.01, 0.004
"""A point of the floor lies within NOISE_M + NOISE_PER_M z^2 of it."""
LEVEL = 0.8
"""Cosine of the angle between the floor's normal and the image's columns, at least: 37 deg."""
NEARER_M = 3.0
BELOW_ROW = 150


def read_outlines(path: Path) -> Mapping[str, Outline]:
    """By the name of an image, the corners of its bare floor, (column, row) px."""
    outlines: Mapping[str, Outline] = yaml.safe_load(path.read_text(encoding="utf-8"))
    return outlines


def read_depth(path: Path) -> Float32s:
    """(H, W) m, of a PNG in mm; holes are NaN."""
    import cv2  # noqa: PLC0415

    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise InputError("no picture", where=str(path), remedy="Give a PNG of 16 bit")
    return np.where(image > 0, image / 1000.0, np.nan).astype(np.float32)


def floor_beams(
    depth_m: Float32s, outline: Outline, T_base_camera: Array
) -> tuple[int, int, float]:
    """(beams whose range comes from pixels of bare floor, beams that look at some, share free).

    Of an image of ``K_D435``; free is that share of the floor's pixels that was found to be.
    """
    import cv2  # noqa: PLC0415

    height, width = depth_m.shape
    camera = CameraCalibration(T_base_camera, Intrinsics(K_D435, width, height))
    project = DepthProjection(camera, DepthConfig())
    area = np.zeros(depth_m.shape, dtype=np.uint8)
    cv2.fillPoly(area, [np.array(outline, dtype=np.int32)], 1)
    image = DepthImage(0, "d435", depth_m)
    labels, bins = project.used_pixels(image), project.bins_of_pixels()
    inside = (area == 1) & (bins >= 0)
    false = np.unique(bins[inside & (labels == NEAREST)]).size
    return false, np.unique(bins[inside]).size, float((labels[inside] == FREE).mean())


def standing(depth_m: Float32s, K: Array, heights_m: tuple[float, float]) -> Array:
    """T_base_camera, (4, 4): the base on the floor below the camera, x ahead.

    The floor is the largest plane below that is within 37 deg of level and so far under the
    camera, by RANSAC and least squares. heights_m : (from, to).
    """
    rng = np.random.default_rng(0)
    rows = np.arange(depth_m.shape[0]) > BELOW_ROW
    v, u = np.nonzero((depth_m < NEARER_M) & rows[:, None])
    chosen = rng.choice(v.size, POINTS)
    v, u = v[chosen], u[chosen]
    z = depth_m[v, u].astype(np.float64)
    points = np.column_stack([(u - K[0, 2]) / K[0, 0] * z, (v - K[1, 2]) / K[1, 1] * z, z])
    allowed_m = NOISE_M + NOISE_PER_M * z**2
    most, up, height_m = 0, np.zeros(3), 0.0
    for _ in range(TRIALS):
        a, b, c = points[rng.choice(len(points), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-6 or abs(normal[1]) < LEVEL * length:
            continue
        normal *= -np.sign(normal[1]) / length
        if not heights_m[0] < -normal @ a < heights_m[1]:
            continue
        inside = int((np.abs(points @ normal - normal @ a) < allowed_m).sum())
        if inside > most:
            most, up, height_m = inside, normal, float(-normal @ a)
    for _ in range(5):
        floor = np.abs(points @ up + height_m) < allowed_m
        weights = 1.0 / allowed_m[floor]
        scaled = np.linalg.lstsq(points[floor] * weights[:, None], -weights, rcond=None)[0]
        height_m = float(1.0 / np.linalg.norm(scaled))
        up = np.asarray(scaled * height_m, dtype=np.float64)
    ahead = np.array([0.0, 0.0, 1.0]) - up * up[2]
    ahead /= np.linalg.norm(ahead)
    T = np.eye(4)
    T[:3, :3] = np.vstack([ahead, np.cross(up, ahead), up])
    T[2, 3] = height_m
    return T


def nodded(T_base_camera: Array, down_rad: float) -> Array:
    """The same camera looking farther down, its base's origin as pivot."""
    c, s = math.cos(down_rad), math.sin(down_rad)
    R = np.eye(4)
    R[:3, :3] = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    turned: Array = R @ T_base_camera
    return turned
