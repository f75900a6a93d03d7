"""The hot loop of the correlative search: branch and bound over a likelihood pyramid."""

from __future__ import annotations

import math

import numpy as np
from numba import njit

from frontend.kernel_types import Bytes, Floats, Ints


@njit(cache=True)
def _nearest_zero(first: int, span: int) -> int:
    """The offset nearest to zero among first .. first + span - 1."""
    if first > 0:
        return first
    last = first + span - 1
    if last < 0:
        return last
    return 0


@njit(cache=True)
def _box_bound(
    cells: Ints,
    d_row: int,
    d_col: int,
    level: int,
    field: Bytes,
    start: int,
    level_rows: int,
    level_cols: int,
    turn_penalty: float,
    xy_weight: float,
    cell_m: float,
    best: float,
) -> float:
    """What no pose in a box can exceed; -inf as soon as it can't be more than the best.

    The box begins at the offset (d_row, d_col) and is 2^level cells wide: the level's sum under the
    points, less the penalties of the pose in it that is nearest to the guess.
    """
    n = cells.shape[0]
    norm = 255.0 * max(n, 1)
    near_row = _nearest_zero(d_row, 1 << level)
    near_col = _nearest_zero(d_col, 1 << level)
    away2 = (near_row * near_row + near_col * near_col) * cell_m * cell_m
    penalty = turn_penalty + xy_weight * away2
    wanted = (best + penalty) * norm
    total = 0
    most = 255 * n
    for i in range(n):
        row = (cells[i, 0] + d_row) >> level
        col = (cells[i, 1] + d_col) >> level
        value = 0
        if 0 <= row < level_rows and 0 <= col < level_cols:
            value = int(field[start + row * level_cols + col])
            total += value
        most -= 255 - value
        if most <= wanted:
            return -np.inf
    return total / norm - penalty


@njit(cache=True)
def apart_rad(a_rad: float, b_rad: float) -> float:
    """Between two angles, on whatever branch: for differences up to 3 pi."""
    apart = abs(a_rad - b_rad)
    return min(apart, abs(apart - 2.0 * math.pi))


@njit(cache=True)
def branch_and_bound(
    points: Floats,
    x0: float,
    y0: float,
    yaw0: float,
    half_x_cells: int,
    half_yaw_steps: int,
    yaw_step: float,
    field: Bytes,
    level_starts: Ints,
    rows: int,
    cols: int,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    xy_weight: float,
    yaw_weight: float,
    min_score: float,
    budget: int,
    avoid_x: float,
    avoid_y: float,
    avoid_yaw: float,
    avoid_m: float,
    avoid_rad: float,
) -> tuple[bool, float, float, float, float, int]:
    """The pose in a window around a guess that lays the points best on a field.

    Olson, Real-Time Correlative Scan Matching (ICRA 2009), with the depth-first branch and bound
    of Hess et al. (ICRA 2016). Score: mean field under the points, less a penalty
    xy_weight d^2 + yaw_weight a^2 for moving d metres and a radians away from the guess.
    The window is a square of half_x_cells cells and half_yaw_steps yaw steps each way.
    budget : after so many scored boxes the search ends with what it has; no more than the coarsest
              boxes of one yaw come on top.
    avoid_* : poses nearer to this one than avoid_m and avoid_rad don't count: to look for a second
              peak after the first. A negative avoid_m counts all.

    Returns (found, x, y, yaw, penalised score, boxes scored).
    """
    n = points.shape[0]
    levels = level_starts.shape[0] - 1
    top = 0
    while top < levels - 1 and (1 << top) < half_x_cells + 1:
        top += 1
    side = 2 * half_x_cells + 1
    cells = np.empty((n, 2), dtype=np.int64)
    best = min_score
    best_row = 0
    best_col = 0
    best_step = 0
    found = False
    scored = 0
    # depth-first stack: level, d_row, d_col, bound
    stack = np.empty((4 * (levels + 1) + ((side >> top) + 2) ** 2, 3), dtype=np.int64)
    bounds = np.empty(stack.shape[0])
    child_bound = np.empty(4)
    child_cell = np.empty((4, 2), dtype=np.int64)
    for k in range(2 * half_yaw_steps + 1):
        # from the guess outwards: the likely answer first makes the bound tight early
        step = (k + 1) // 2 if k % 2 == 1 else -(k // 2)
        turn = step * yaw_step
        turn_penalty = yaw_weight * turn * turn
        if 1.0 - turn_penalty <= best:
            continue
        c = math.cos(yaw0 + turn)
        s = math.sin(yaw0 + turn)
        for i in range(n):
            px = x0 + c * points[i, 0] - s * points[i, 1]
            py = y0 + s * points[i, 0] + c * points[i, 1]
            cells[i, 0] = int(math.floor((py - origin_y) / cell_m))
            cells[i, 1] = int(math.floor((px - origin_x) / cell_m))
        depth = 0
        span = 1 << top
        for d_row in range(-half_x_cells, half_x_cells + 1, span):
            for d_col in range(-half_x_cells, half_x_cells + 1, span):
                bound = _box_bound(
                    cells,
                    d_row,
                    d_col,
                    top,
                    field,
                    level_starts[top],
                    rows >> top,
                    cols >> top,
                    turn_penalty,
                    xy_weight,
                    cell_m,
                    best,
                )
                scored += 1
                if bound > best:
                    # keep the roots in order of their bound, best on top
                    at = depth
                    while at > 0 and bounds[at - 1] > bound:
                        bounds[at] = bounds[at - 1]
                        stack[at, 0] = stack[at - 1, 0]
                        stack[at, 1] = stack[at - 1, 1]
                        stack[at, 2] = stack[at - 1, 2]
                        at -= 1
                    bounds[at] = bound
                    stack[at, 0] = top
                    stack[at, 1] = d_row
                    stack[at, 2] = d_col
                    depth += 1
        while depth > 0:
            depth -= 1
            if bounds[depth] <= best:
                continue
            if scored >= budget:
                break
            level = stack[depth, 0]
            row = stack[depth, 1]
            col = stack[depth, 2]
            if level == 0:
                if (
                    math.hypot(x0 + col * cell_m - avoid_x, y0 + row * cell_m - avoid_y) < avoid_m
                    and apart_rad(yaw0 + turn, avoid_yaw) < avoid_rad
                ):
                    continue
                best = bounds[depth]
                best_row = row
                best_col = col
                best_step = step
                found = True
                continue
            level -= 1
            span = 1 << level
            children = 0
            for a in range(2):
                for b in range(2):
                    d_row = row + a * span
                    d_col = col + b * span
                    if d_row > half_x_cells or d_col > half_x_cells:
                        continue
                    bound = _box_bound(
                        cells,
                        d_row,
                        d_col,
                        level,
                        field,
                        level_starts[level],
                        rows >> level,
                        cols >> level,
                        turn_penalty,
                        xy_weight,
                        cell_m,
                        best,
                    )
                    scored += 1
                    if bound <= best:
                        continue
                    at = children
                    while at > 0 and child_bound[at - 1] > bound:
                        child_bound[at] = child_bound[at - 1]
                        child_cell[at, 0] = child_cell[at - 1, 0]
                        child_cell[at, 1] = child_cell[at - 1, 1]
                        at -= 1
                    child_bound[at] = bound
                    child_cell[at, 0] = d_row
                    child_cell[at, 1] = d_col
                    children += 1
            for a in range(children):
                stack[depth, 0] = level
                stack[depth, 1] = child_cell[a, 0]
                stack[depth, 2] = child_cell[a, 1]
                bounds[depth] = child_bound[a]
                depth += 1
        if scored >= budget:
            break
    return (
        found,
        x0 + best_col * cell_m,
        y0 + best_row * cell_m,
        yaw0 + best_step * yaw_step,
        best,
        scored,
    )
