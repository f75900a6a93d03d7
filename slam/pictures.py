"""The map as a picture for people: walls, the way driven, a scale bar."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.trajectory import Trajectory
from slam.occupancy import FREE, OCCUPIED, UNKNOWN, MapConfig, Raster

Picture = npt.NDArray[np.uint8]

GREYS = {UNKNOWN: 224, FREE: 255, OCCUPIED: 0}
# Blue, green, red, as OpenCV orders them.
WAY, START, END, INK = (200, 110, 20), (60, 160, 40), (40, 40, 210), (70, 70, 70)
LEGIBLE_PX = 1200
"""Cells of small maps are drawn as squares of several pixels, up to about this width."""
SUBPIXEL_BITS = 4


def write_picture(path: Path, grid: Raster, config: MapConfig, T_map_base: Trajectory) -> None:
    """Write a PNG: north (map y) up, free white, unknown grey, walls black.

    The way of the base is a thin blue line from a green disc (start) to a red square (end).
    Raises OSError where the file cannot be written.
    """
    import cv2  # noqa: PLC0415  (commands without pictures do without it)

    classes = grid.classes(config)
    palette = np.array([GREYS[k] for k in sorted(GREYS)], np.uint8)
    scale = max(1, math.ceil(LEGIBLE_PX / max(classes.shape)))
    grey = palette[classes][::-1].repeat(scale, axis=0).repeat(scale, axis=1)
    picture = np.ascontiguousarray(np.repeat(grey[:, :, None], 3, axis=2))

    thickness = max(1, round(max(picture.shape) / 1500))
    way_px = _pixels(grid, T_map_base.xyyaw[:, :2], scale)
    if len(way_px):
        fixed = np.round(way_px * 2**SUBPIXEL_BITS).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [fixed], False, WAY, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
        radius = 4 * thickness
        (sx, sy), (ex, ey) = (np.round(way_px[k]).astype(int).tolist() for k in (0, -1))
        cv2.rectangle(picture, (ex - radius, ey - radius), (ex + radius, ey + radius), END, -1)
        cv2.circle(picture, (sx, sy), radius, START, -1, cv2.LINE_AA)
    picture = _with_scale_bar(picture, scale / grid.resolution_m)
    encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1]
    path.write_bytes(encoded.tobytes())


def _pixels(grid: Raster, points_map: Array, scale: int) -> Array:
    """Points (N, 2) in the map, m, as (column, row) of the scaled picture's pixel centres."""
    cells = (points_map - np.array(grid.corner_map_m)) / grid.resolution_m
    cells[:, 1] = grid.shape[0] - cells[:, 1]
    return np.asarray(cells * scale - 0.5, np.float64)


def _with_scale_bar(picture: Picture, pixels_per_m: float) -> Picture:
    """The picture with a strip below it that holds a bar of a round length."""
    import cv2  # noqa: PLC0415

    width = picture.shape[1]
    size = max(0.5, width / 1500)
    margin = round(16 * size)
    strip = np.full((round(48 * size), width, 3), 255, np.uint8)
    length_m = _round_down(0.3 * width / pixels_per_m)
    left, right, y = margin, margin + round(length_m * pixels_per_m), strip.shape[0] // 2
    thick = max(2, round(3 * size))
    cv2.line(strip, (left, y), (right, y), INK, thick)
    for x in (left, right):
        cv2.line(strip, (x, y - margin // 2), (x, y + margin // 2), INK, thick)
    cv2.putText(
        strip,
        f"{length_m:g} m",
        (right + margin, y + margin // 2),
        cv2.FONT_HERSHEY_SIMPLEX,
        0.8 * size,
        INK,
        max(1, round(1.5 * size)),
        cv2.LINE_AA,
    )
    return np.vstack([picture, strip])


def _round_down(length_m: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(k * power for k in (1.0, 2.0, 5.0) if k * power <= length_m * (1 + 1e-9))
