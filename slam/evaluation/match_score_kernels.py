"""Hot loop of the probability grids that match scores are read from."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt
from numba import njit

Array = npt.NDArray[np.float64]


@njit(cache=True)
def insert_scan(
    log_odds: npt.NDArray[np.float32],
    updated: npt.NDArray[np.int32],
    scan: int,
    origin_cells: Array,
    points_cells: Array,
    hit: float,
    miss: float,
    least: float,
    most: float,
) -> None:  # pragma: no cover
    """Add one scan to a grid in place; O(points x cells of a ray).

    log_odds, updated : (H, W); ``updated`` holds the number of the last scan that changed a cell.
    scan              : this scan's number, from 1.
    origin_cells (2,), points_cells (N, 2) : x, y in cells from the grid's corner, all inside.
    hit, miss : what is added; ``least`` and ``most`` bound the sum.

    First all end cells take ``hit``, then the cells that a ray runs through before its end take
    ``miss``; no cell changes twice. The way is Amanatides and Woo's (Eurographics 1987).
    """
    for i in range(points_cells.shape[0]):
        column, row = int(math.floor(points_cells[i, 0])), int(math.floor(points_cells[i, 1]))
        if updated[row, column] != scan:
            updated[row, column] = scan
            log_odds[row, column] = min(log_odds[row, column] + hit, most)
    for i in range(points_cells.shape[0]):
        end_x, end_y = int(math.floor(points_cells[i, 0])), int(math.floor(points_cells[i, 1]))
        x, y = int(math.floor(origin_cells[0])), int(math.floor(origin_cells[1]))
        dx, dy = points_cells[i, 0] - origin_cells[0], points_cells[i, 1] - origin_cells[1]
        step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
        next_x = next_y = delta_x = delta_y = math.inf
        if dx != 0.0:
            delta_x = abs(1.0 / dx)
            next_x = ((x + (step_x > 0)) - origin_cells[0]) / dx
        if dy != 0.0:
            delta_y = abs(1.0 / dy)
            next_y = ((y + (step_y > 0)) - origin_cells[1]) / dy
        for _ in range(abs(end_x - x) + abs(end_y - y)):
            if updated[y, x] != scan:
                updated[y, x] = scan
                log_odds[y, x] = max(log_odds[y, x] + miss, least)
            # Rounding must not lead past the end in one direction.
            if (next_x <= next_y and x != end_x) or y == end_y:
                x += step_x
                next_x += delta_x
            else:
                y += step_y
                next_y += delta_y
