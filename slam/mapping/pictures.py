"""The map as pictures for people: walls, or which sensor saw them; the way driven, a scale bar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import cycle
from pathlib import Path

import numpy as np
import numpy.typing as npt

from datasets.messages import Array
from datasets.trajectory import Trajectory
from slam.mapping.layers import LayeredMap
from slam.mapping.occupancy import FREE, MAX_CELLS, OCCUPIED, UNKNOWN, MapConfig, Raster
from slam.mapping.scan_store import LIDAR

Picture = npt.NDArray[np.uint8]
Colour = tuple[int, int, int]

GREYS = {UNKNOWN: 224, FREE: 255, OCCUPIED: 0}
# Blue, green, red, as OpenCV orders them.
WAY, START, END, INK = (200, 110, 20), (60, 160, 40), (40, 40, 210), (70, 70, 70)
DOUBT = (0, 120, 255)
RING_M = 1.5
SEVERAL = (115, 158, 0)
"""A cell that is occupied, in the same place or next to it, by more than one layer,"""
BY_LAYER = ((0, 94, 213), (60, 45, 40), (170, 50, 170), (0, 159, 230))
"""and one by a single layer: in order of the layers' names, but the second is the lidars'."""
LEGIBLE_PX = 1200
"""Cells of small maps are drawn as squares of several pixels, up to about this width."""
MOST_PX = 30_000
"""Larger pictures, of trajectories that ran away, are shrunk: nothing would show them."""
SUBPIXEL_BITS = 4


def write_picture(
    path: Path,
    grid: Raster,
    config: MapConfig,
    T_map_base: Trajectory,
    doubtful: Sequence[tuple[float, float]] = (),
) -> None:
    """Write a PNG: north (map y) up, free white, unknown grey, walls black.

    The way of the base is a thin blue line from a green disc (start) to a red square (end).
    doubtful : (x, y) m in the map, places to look at: each gets an orange ring.
    Raises OSError where the file cannot be written.
    """
    picture = _painted(_greys(grid, config), grid, T_map_base)
    _ring(picture, grid, doubtful)
    _write_png(path, _with_scale_bar(picture, grid))


def _ring(picture: Picture, grid: Raster, places: Sequence[tuple[float, float]]) -> None:
    """Draw a ring of RING_M around places in the map, no smaller than can be seen."""
    import cv2  # noqa: PLC0415

    scale = _scale(grid)
    size = max(1, round(max(grid.shape) * scale / 750))
    radius = max(8 * size, round(RING_M * scale / grid.resolution_m))
    for x, y in _pixels(grid, np.array(places, dtype=np.float64).reshape(-1, 2), scale):
        cv2.circle(picture, (round(x), round(y)), radius, DOUBT, 2 * size, cv2.LINE_AA)


def write_sources(
    path: Path, layers: LayeredMap, config: MapConfig, T_map_base: Trajectory
) -> None:
    """Write a PNG as ``write_picture`` does, each occupied cell coloured by the layer that saw it.

    Where layers agree to a cell they share a colour of their own. The legend names the colours.
    Raises OSError where the file cannot be written.
    """
    import cv2  # noqa: PLC0415

    occupied = {name: grid.classes(config) == OCCUPIED for name, grid in layers.layers.items()}
    near = [cv2.dilate(mask.astype(np.uint8), np.ones((3, 3))) for mask in occupied.values()]
    agreeing = np.add.reduce(near) > 1
    colours = _greys(layers, config)
    legend = [("where the robot drove", WAY)]
    alone = len(occupied) == 1
    for name, colour in _by_layer(list(occupied)).items():
        colours[occupied[name]] = colour
        legend.insert(-1, (name if alone else f"{name} only", colour))
    for mask in occupied.values():
        colours[mask & agreeing] = SEVERAL
    if not alone:
        legend.insert(-1, ("both" if len(occupied) == 2 else "several", SEVERAL))
    picture = _with_scale_bar(_painted(colours, layers, T_map_base), layers)
    _write_png(path, _with_legend(picture, legend))


def _greys(grid: Raster, config: MapConfig) -> Picture:
    """(height, width, 3), one pixel a cell, row 0 at the smallest y."""
    palette = np.array([[GREYS[k]] * 3 for k in sorted(GREYS)], np.uint8)
    return palette[grid.classes(config)]


def _scale(grid: Raster) -> int:
    """Pixels to the side of a cell."""
    return max(1, math.ceil(LEGIBLE_PX / max(grid.shape)))


def _by_layer(names: Sequence[str]) -> dict[str, Colour]:
    """The colour of each layer: the lidars' is the same whatever other layers there are."""
    first, dark, *rest = BY_LAYER
    others = cycle((first, *rest) if LIDAR in names else BY_LAYER)
    return {name: dark if name == LIDAR else next(others) for name in names}


def _painted(colours: Picture, grid: Raster, T_map_base: Trajectory) -> Picture:
    """The cells enlarged, north up, with the way on them, over a white strip for a scale bar."""
    import cv2  # noqa: PLC0415

    scale = _scale(grid)
    north_up = colours[::-1]
    if scale > 1:
        north_up = north_up.repeat(scale, axis=0).repeat(scale, axis=1)
    height, width = north_up.shape[:2]
    whole = np.full((height + _strip_px(width), width, 3), 255, np.uint8)
    picture = whole[:height]
    picture[:] = north_up
    thickness = max(1, round(max(picture.shape) / 1500))
    way_px = _pixels(grid, T_map_base.xyyaw[:, :2], scale)
    if len(way_px):
        fixed = np.round(way_px * 2**SUBPIXEL_BITS).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(picture, [fixed], False, WAY, thickness, cv2.LINE_AA, SUBPIXEL_BITS)
        radius = 4 * thickness
        (sx, sy), (ex, ey) = (np.round(way_px[k]).astype(int).tolist() for k in (0, -1))
        cv2.rectangle(picture, (ex - radius, ey - radius), (ex + radius, ey + radius), END, -1)
        cv2.circle(picture, (sx, sy), radius, START, -1, cv2.LINE_AA)
    return whole


def _strip_px(width: int) -> int:
    """The height of the strip below a picture that holds its scale bar."""
    return round(48 * _text_size(width))


def _write_png(path: Path, picture: Picture) -> None:
    import cv2  # noqa: PLC0415  (commands without pictures do without it)

    height, width = picture.shape[:2]
    if max(height, width) > MOST_PX:
        factor = MOST_PX / max(height, width)
        size = max(1, round(width * factor)), max(1, round(height * factor))
        picture = np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
    encoded = cv2.imencode(".png", picture, [cv2.IMWRITE_PNG_COMPRESSION, 3])[1]
    path.write_bytes(encoded.tobytes())


def _pixels(grid: Raster, points_map: Array, scale: int) -> Array:
    """Points (N, 2) in the map, m, as (column, row) of the scaled picture's pixel centres."""
    cells = (points_map - np.array(grid.corner_map_m)) / grid.resolution_m
    cells[:, 1] = grid.shape[0] - cells[:, 1]
    return np.asarray(cells * scale - 0.5, np.float64)


def _with_scale_bar(picture: Picture, grid: Raster) -> Picture:
    """The picture with a bar of a round length in the strip at its lower end."""
    import cv2  # noqa: PLC0415

    pixels_per_m = _scale(grid) / grid.resolution_m
    width = picture.shape[1]
    size = _text_size(width)
    margin = round(16 * size)
    strip = picture[-_strip_px(width) :]
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
    return picture


def _with_legend(picture: Picture, legend: Sequence[tuple[str, Colour]]) -> Picture:
    """The picture with a strip below it: a square of each colour and what it means, in lines."""
    import cv2  # noqa: PLC0415

    width = picture.shape[1]
    size = _text_size(width)
    margin, line = round(16 * size), round(36 * size)
    font, thick = cv2.FONT_HERSHEY_SIMPLEX, max(1, round(1.5 * size))
    places, x, y = [], margin, 0
    for words, colour in legend:
        text = words.encode("ascii", "replace").decode("ascii")
        needed = line + cv2.getTextSize(text, font, 0.8 * size, thick)[0][0] + 2 * margin
        if x + needed > width and x > margin:
            x, y = margin, y + line
        places.append((text, colour, x, y))
        x += needed
    strip = np.full((y + line + margin // 2, width, 3), 255, np.uint8)
    side = round(20 * size)
    for text, colour, left, top in places:
        cv2.rectangle(strip, (left, top), (left + side, top + side), colour, -1)
        at = (left + line - margin // 2, top + side - round(2 * size))
        cv2.putText(strip, text, at, font, 0.8 * size, INK, thick, cv2.LINE_AA)
    return np.vstack([picture, strip])


def _text_size(width: int) -> float:
    """Of words and bars, 1 in a picture of 1500 pixels; a strip of it is no larger than a map."""
    return max(0.5, min(width / 1500, MAX_CELLS / (48 * width)))


def _round_down(length_m: float) -> float:
    """The largest 1, 2 or 5 times a power of ten that is not longer."""
    power = 10.0 ** math.floor(math.log10(length_m))
    return max(k * power for k in (1.0, 2.0, 5.0) if k * power <= length_m * (1 + 1e-9))
