"""The loops over every beam of every scan that draw the occupancy grid."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

from fusion.kernel_types import FAST, Bytes, Float32s, Floats, Ints

Marks = npt.NDArray[np.int32]

FOOTING_GAP_M = 1.0
"""Neighbouring hits further apart than this are not taken for one surface."""
STEEPEST = 10.0
"""A margin is stretched at most this often along a ray that grazes its wall (under 6 deg)."""
BEAM, CLEAR = 0, 2
"""Roles of points as in scan_store."""


@njit(cache=True, fastmath=FAST)
def extent(
    points_base: Float32s,
    offsets: Ints,
    sensor_index: Ints,
    origins_base: Floats,
    xyyaw: Floats,
    max_range_m: float,
) -> tuple[float, float, float, float]:
    """(x min, y min, x max, y max) m, map frame, of sensors and of hits within max_range_m.

    points_base : (M, 2) float32; scan i owns rows offsets[i]:offsets[i + 1] and was seen from
    origins_base[sensor_index[i]] at xyyaw[i] (pose of the base in the map). O(M).
    """
    x_min, y_min, x_max, y_max = math.inf, math.inf, -math.inf, -math.inf
    for i in range(xyyaw.shape[0]):
        c, s = math.cos(xyyaw[i, 2]), math.sin(xyyaw[i, 2])
        ox = origins_base[sensor_index[i], 0]
        oy = origins_base[sensor_index[i], 1]
        x = xyyaw[i, 0] + c * ox - s * oy
        y = xyyaw[i, 1] + s * ox + c * oy
        x_min, x_max = min(x_min, x), max(x_max, x)
        y_min, y_max = min(y_min, y), max(y_max, y)
        for j in range(offsets[i], offsets[i + 1]):
            px, py = float(points_base[j, 0]), float(points_base[j, 1])
            if (px - ox) ** 2 + (py - oy) ** 2 > max_range_m**2:
                continue
            x = xyyaw[i, 0] + c * px - s * py
            y = xyyaw[i, 1] + s * px + c * py
            x_min, x_max = min(x_min, x), max(x_max, x)
            y_min, y_max = min(y_min, y), max(y_max, y)
    return x_min, y_min, x_max, y_max


@njit(cache=True, fastmath=FAST)
def footing(points_base: Float32s, first: int, last: int, j: int, ux: float, uy: float) -> float:
    """|cos| of the angle between ray (ux, uy) and the normal of the surface it ends on.

    The surface is the line to the hit before or after j in the scan (rows first:last),
    whichever is met more squarely; 1 where there is no neighbour. O(1).
    """
    squarest = -1.0
    for k in (j - 1, j + 1):
        if k < first or k >= last:
            continue
        dx = float(points_base[k, 0]) - float(points_base[j, 0])
        dy = float(points_base[k, 1]) - float(points_base[j, 1])
        gap = math.sqrt(dx * dx + dy * dy)
        if 1e-6 < gap < FOOTING_GAP_M:
            squarest = max(squarest, abs(ux * dy - uy * dx) / gap)
    return squarest if squarest >= 0.0 else 1.0


@njit(cache=True, fastmath=FAST)
def walk(
    marks: Marks,
    hits: Float32s,
    passes: Float32s,
    mark: int,
    hit_weight: float,
    memory: float,
    x: float,
    y: float,
    ux: float,
    uy: float,
    length: float,
) -> None:
    """Visit every cell that a ray crosses, in order, and count it as passed once per mark.

    x, y, length in cells from the grid's corner, (ux, uy) the unit direction; a ray that starts
    outside of the grid visits nothing, the walk ends where the ray leaves it. Cells whose mark is
    already >= mark keep their count. O(length).
    Source: Amanatides and Woo, A Fast Voxel Traversal Algorithm, Eurographics 1987.
    """
    height, width = marks.shape
    ix, iy = math.floor(x), math.floor(y)
    if not (0 <= ix < width and 0 <= iy < height):
        return
    step_x, step_y = (1 if ux > 0.0 else -1), (1 if uy > 0.0 else -1)
    delta_x, delta_y, next_x, next_y = math.inf, math.inf, math.inf, math.inf
    if abs(ux) > 1e-12:
        delta_x = 1.0 / abs(ux)
        next_x = ((ix + 1 - x) if ux > 0.0 else (x - ix)) * delta_x
    if abs(uy) > 1e-12:
        delta_y = 1.0 / abs(uy)
        next_y = ((iy + 1 - y) if uy > 0.0 else (y - iy)) * delta_y
    while True:
        if marks[iy, ix] < mark:
            marks[iy, ix] = mark
            passed = passes[iy, ix] + 1.0
            excess = hit_weight * hits[iy, ix] + passed - memory
            if excess > 0.0:
                hits[iy, ix] = max(0.0, hits[iy, ix] - excess / hit_weight)
                passed = min(passed, memory)
            passes[iy, ix] = passed
        if next_x < next_y:
            if next_x >= length:
                return
            next_x += delta_x
            ix += step_x
            if ix < 0 or ix >= width:
                return
        else:
            if next_y >= length:
                return
            next_y += delta_y
            iy += step_y
            if iy < 0 or iy >= height:
                return


@njit(cache=True, fastmath=FAST)
def count(
    points_base: Float32s,
    offsets: Ints,
    sensor_index: Ints,
    origins_base: Floats,
    xyyaw: Floats,
    roles: Bytes,
    clear_from_m: Floats,
    corner_x_m: float,
    corner_y_m: float,
    resolution_m: float,
    max_range_m: float,
    margin_cells: float,
    hit_weight: float,
    memory: float,
    hits: Float32s,
    passes: Float32s,
) -> None:
    """Add every scan's vote to the cells of a grid: hit, passed, or neither.

    Arguments as in ``extent``; roles (M,) and clear_from_m (K,) as in ScanStore; hits and passes
    are (height, width) float32, row 0 at the smallest y, and are added to. Each scan has one vote
    per cell, and a hit outweighs a pass, so a chair leg that one beam finds and three beams pass
    is found. Free space ends margin_cells before the hit, measured across the surface: a ray that
    grazes a wall runs long in the cells next to it, and would erase it there. A ray longer than
    max_range_m frees cells up to that range and hits nothing, one of role CLEAR frees them to its
    very end. A cell remembers hit_weight * hits + passes <= memory: what is too much is taken from
    the votes of the other kind. O(sum of ranges / resolution_m).
    """
    marks = np.zeros(hits.shape, np.int32)
    height, width = hits.shape
    for i in range(xyyaw.shape[0]):
        c, s = math.cos(xyyaw[i, 2]), math.sin(xyyaw[i, 2])
        ox = origins_base[sensor_index[i], 0]
        oy = origins_base[sensor_index[i], 1]
        x = (xyyaw[i, 0] + c * ox - s * oy - corner_x_m) / resolution_m
        y = (xyyaw[i, 1] + s * ox + c * oy - corner_y_m) / resolution_m
        skipped = clear_from_m[sensor_index[i]] / resolution_m
        passed, hit = 2 * i + 1, 2 * i + 2
        first, last = offsets[i], offsets[i + 1]
        for j in range(first, last):
            dx, dy = float(points_base[j, 0]) - ox, float(points_base[j, 1]) - oy
            if roles[j] != CLEAR and dx * dx + dy * dy <= max_range_m**2:
                ix = math.floor(x + (c * dx - s * dy) / resolution_m)
                iy = math.floor(y + (s * dx + c * dy) / resolution_m)
                if 0 <= ix < width and 0 <= iy < height and marks[iy, ix] < hit:
                    marks[iy, ix] = hit
                    seen = min(hits[iy, ix] + 1.0, memory / hit_weight)
                    hits[iy, ix] = seen
                    passes[iy, ix] = min(passes[iy, ix], memory - hit_weight * seen)
        for j in range(first, last):
            if roles[j] != BEAM and roles[j] != CLEAR:
                continue
            dx, dy = float(points_base[j, 0]) - ox, float(points_base[j, 1]) - oy
            range_m = math.sqrt(dx * dx + dy * dy)
            if range_m < 1e-6:
                continue
            ux, uy = dx / range_m, dy / range_m
            length = min(range_m, max_range_m) / resolution_m
            if range_m <= max_range_m and roles[j] == BEAM:
                square = footing(points_base, first, last, j, ux, uy)
                length -= margin_cells / max(square, 1.0 / STEEPEST)
            length -= skipped
            if length > 0.0:
                vx, vy = c * ux - s * uy, s * ux + c * uy
                from_x, from_y = x + skipped * vx, y + skipped * vy
                walk(
                    marks, hits, passes, passed, hit_weight, memory,
                    from_x, from_y, vx, vy, length,
                )  # fmt: skip


@njit(cache=True, fastmath=FAST)
def mark_strays(
    points_base: Float32s,
    offsets: Ints,
    sensor_index: Ints,
    origins_base: Floats,
    xyyaw: Floats,
    roles: Bytes,
    corner_x_m: float,
    corner_y_m: float,
    resolution_m: float,
    max_range_m: float,
    far_m: float,
    reach_m: float,
    times: float,
    hits: Float32s,
    stray: Bytes,
    sound: Bytes,
) -> None:
    """Mark the cells with far hits that a much surer cell before them explains, and with others.

    Arguments as in ``count``. A hit is a stray if it is of a beam longer than far_m and a cell on
    its ray, at most reach_m before it, has at least ``times`` as many hits as its own. stray and
    sound are (height, width) uint8, set to 1. O(points * reach_m / resolution_m).
    """
    height, width = hits.shape
    steps = math.ceil(2.0 * reach_m / resolution_m)
    for i in range(xyyaw.shape[0]):
        c, s = math.cos(xyyaw[i, 2]), math.sin(xyyaw[i, 2])
        ox = origins_base[sensor_index[i], 0]
        oy = origins_base[sensor_index[i], 1]
        x = (xyyaw[i, 0] + c * ox - s * oy - corner_x_m) / resolution_m
        y = (xyyaw[i, 1] + s * ox + c * oy - corner_y_m) / resolution_m
        for j in range(offsets[i], offsets[i + 1]):
            dx, dy = float(points_base[j, 0]) - ox, float(points_base[j, 1]) - oy
            range_m = math.sqrt(dx * dx + dy * dy)
            if roles[j] != BEAM or range_m > max_range_m:
                continue
            vx, vy = (c * dx - s * dy) / resolution_m, (s * dx + c * dy) / resolution_m
            ix, iy = math.floor(x + vx), math.floor(y + vy)
            if not (0 <= ix < width and 0 <= iy < height):
                continue
            explained = False
            if range_m > far_m:
                for k in range(1, steps + 1):
                    back = 1.0 - 0.5 * k * resolution_m / range_m
                    kx, ky = math.floor(x + back * vx), math.floor(y + back * vy)
                    if 0 <= kx < width and 0 <= ky < height:
                        explained = explained or hits[ky, kx] >= times * max(hits[iy, ix], 1.0)
            if explained:
                stray[iy, ix] = 1
            else:
                sound[iy, ix] = 1
