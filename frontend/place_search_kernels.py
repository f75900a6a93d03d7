"""The hot loops of the search for places: which yaws are worth a look, and branch and bound.

``search_kernels`` suits the small windows of tracking. A window of tens of metres and any yaw is
another task: here coarser levels of the field come first, the yaws are chosen by how the surfaces
face, and all yaws' boxes stand in one order.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from frontend.kernel_types import Bytes, Floats, Ints
from frontend.search_kernels import apart_rad


@njit(cache=True)
def pooled(finer: Bytes, rows: int, cols: int, is_padded: bool, out: Bytes) -> None:
    """The next level of a likelihood pyramid, padded by a cell at its low sides.

    A level's cell k holds the most in the cells [k span, (k + 2) span) of level 0.

    finer : (rows, cols) the level below, padded by one cell if ``is_padded``.
    out   : (R, C) uint8, its cell (r, c) stands for cell (r - 1, c - 1) of the level.
    """
    pad = 1 if is_padded else 0
    for r in range(out.shape[0]):
        for c in range(out.shape[1]):
            most = np.uint8(0)
            for a in (0, 2):
                row = 2 * (r - 1) + a + pad
                if row < 0 or row >= rows:
                    continue
                for b in (0, 2):
                    col = 2 * (c - 1) + b + pad
                    if 0 <= col < cols and finer[row, col] > most:
                        most = finer[row, col]
            out[r, c] = most


@njit(cache=True)
def facing(normals: Floats, out: Floats) -> None:
    """Histogram of the directions that surfaces face, (B,) over a full turn, each counted with
    its two neighbours in the shares 1/4, 1/2, 1/4; zero normals don't count. Sums to 1."""
    bins = out.shape[0]
    out[:] = 0.0
    count = 0
    for i in range(normals.shape[0]):
        if normals[i, 0] == 0.0 and normals[i, 1] == 0.0:
            continue
        angle = math.atan2(normals[i, 1], normals[i, 0])
        k = int(math.floor(angle / (2.0 * math.pi) * bins)) % bins
        out[(k - 1) % bins] += 0.25
        out[k] += 0.5
        out[(k + 1) % bins] += 0.25
        count += 1
    if count:
        out /= count


@njit(cache=True)
def agreement(of_map: Floats, of_scan: Floats, out: Floats) -> None:
    """How well surfaces face the same way if a scan is turned by k bins: sum of min, (B,)."""
    bins = of_map.shape[0]
    for k in range(bins):
        total = 0.0
        for i in range(bins):
            total += min(of_map[(i + k) % bins], of_scan[i])
        out[k] = total


@njit(cache=True)
def _bound(
    cells: Ints,
    d_row: int,
    d_col: int,
    level: int,
    field: Bytes,
    start: int,
    level_rows: int,
    level_cols: int,
    pad: int,
    floor: float,
) -> float:
    """What no pose in a box can exceed; -1 as soon as it can't be more than ``floor``."""
    n = cells.shape[0]
    wanted = floor * 255.0 * n
    total = 0
    most = 255 * n
    for i in range(n):
        row = ((cells[i, 0] + d_row) >> level) + pad
        col = ((cells[i, 1] + d_col) >> level) + pad
        value = 0
        if 0 <= row < level_rows and 0 <= col < level_cols:
            value = int(field[start + row * level_cols + col])
        total += value
        most -= 255 - value
        if most <= wanted:
            return -1.0
    return total / (255.0 * n)


@njit(cache=True)
def search_places(
    points: Floats,
    x0: float,
    y0: float,
    yaws: Floats,
    half_cells: int,
    field: Bytes,
    starts: Ints,
    shapes: Ints,
    pads: Ints,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    min_score: float,
    budget: int,
    avoid_x: float,
    avoid_y: float,
    avoid_yaw: float,
    avoid_m: float,
    avoid_rad: float,
) -> tuple[bool, float, float, float, float, int]:
    """The pose under which a field scores most, within a square and of some yaws.

    Score: mean of the field under the points, in 0..1.

    points     : (N, 2) m, in the base frame.
    yaws       : (K,) rad, those that are tried.
    half_cells : half of the square around (x0, y0).
    field      : flat uint8, level after level; starts : (levels,) where each begins; shapes :
                 (levels, 2) rows and columns; pads : (levels,) cells before a level's cell 0. Cell
                 k of level L > 0 holds the most in the cells [k 2^L, (k + 2) 2^L) of level 0.
    min_score  : what scores less is not looked for.
    budget     : after so many scored boxes the search ends with what it has.
    avoid_*    : poses nearer to this one than avoid_m and avoid_rad don't count. A negative
                 avoid_m counts all.

    Returns (found, x, y, yaw, score, boxes scored). Source: Olson, ICRA 2009; Hess et al., ICRA
    2016, section V-B.
    """
    n = points.shape[0]
    turns = yaws.shape[0]
    levels = shapes.shape[0]
    top = 0
    while top < levels - 1 and (1 << top) < half_cells + 1:
        top += 1
    span = 1 << top
    side = (2 * half_cells) // span + 1
    room = side * side * turns + 4 * (top + 1)
    stack = np.empty((room, 4), dtype=np.int64)
    bounds = np.empty(room)
    cells = np.empty((turns, n, 2), dtype=np.int64)
    best = min_score
    best_row = 0
    best_col = 0
    best_turn = 0
    found = False
    scored = 0
    depth = 0
    child_bound = np.empty(4)
    child = np.empty((4, 2), dtype=np.int64)
    for k in range(turns):
        c = math.cos(yaws[k])
        s = math.sin(yaws[k])
        for i in range(n):
            px = x0 + c * points[i, 0] - s * points[i, 1]
            py = y0 + s * points[i, 0] + c * points[i, 1]
            cells[k, i, 0] = int(math.floor((py - origin_y) / cell_m))
            cells[k, i, 1] = int(math.floor((px - origin_x) / cell_m))
        for d_row in range(-half_cells, half_cells + 1, span):
            for d_col in range(-half_cells, half_cells + 1, span):
                bound = _bound(
                    cells[k],
                    d_row,
                    d_col,
                    top,
                    field,
                    starts[top],
                    shapes[top, 0],
                    shapes[top, 1],
                    pads[top],
                    best,
                )
                scored += 1
                if bound > best:
                    stack[depth, 0] = top
                    stack[depth, 1] = d_row
                    stack[depth, 2] = d_col
                    stack[depth, 3] = k
                    bounds[depth] = bound
                    depth += 1
    order = np.argsort(bounds[:depth], kind="mergesort")
    stack[:depth] = stack[:depth][order]
    bounds[:depth] = bounds[:depth][order]
    while depth > 0:
        depth -= 1
        if bounds[depth] <= best:
            continue
        if scored >= budget:
            break
        level = stack[depth, 0]
        row = stack[depth, 1]
        col = stack[depth, 2]
        k = stack[depth, 3]
        if level == 0:
            if (
                math.hypot(x0 + col * cell_m - avoid_x, y0 + row * cell_m - avoid_y) < avoid_m
                and apart_rad(yaws[k], avoid_yaw) < avoid_rad
            ):
                continue
            best = bounds[depth]
            best_row = row
            best_col = col
            best_turn = k
            found = True
            continue
        level -= 1
        span = 1 << level
        children = 0
        for b in range(4):
            d_row = row + (b >> 1) * span
            d_col = col + (b & 1) * span
            if d_row > half_cells or d_col > half_cells:
                continue
            bound = _bound(
                cells[k],
                d_row,
                d_col,
                level,
                field,
                starts[level],
                shapes[level, 0],
                shapes[level, 1],
                pads[level],
                best,
            )
            scored += 1
            if bound <= best:
                continue
            at = children
            while at > 0 and child_bound[at - 1] > bound:
                child_bound[at] = child_bound[at - 1]
                child[at, 0] = child[at - 1, 0]
                child[at, 1] = child[at - 1, 1]
                at -= 1
            child_bound[at] = bound
            child[at, 0] = d_row
            child[at, 1] = d_col
            children += 1
        for a in range(children):
            stack[depth, 0] = level
            stack[depth, 1] = child[a, 0]
            stack[depth, 2] = child[a, 1]
            stack[depth, 3] = k
            bounds[depth] = child_bound[a]
            depth += 1
    yaw = yaws[best_turn] if turns else 0.0
    return found, x0 + best_col * cell_m, y0 + best_row * cell_m, yaw, best, scored
