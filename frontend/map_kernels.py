"""The hot loops that draw a local map: arrays and scalars in and out, compiled once by Numba.

A local map is two things over the same window of the plane: the points themselves, in a grid of
linked lists (``head`` by cell, ``following`` by point), and a pyramid of likelihood fields.
Level 0 of the pyramid holds, for each cell, 255 exp(-d^2 / 2 sigma^2) with d the distance from the
cell's centre to the nearest point; a cell of level L holds the maximum over the 2^(L+1) x 2^(L+1)
cells of level 0 that begin at its corner. So its value bounds whatever a point can
meet that starts in this cell and is moved by less than 2^L cells towards +x and +y.
All levels lie one after the other in one flat array of uint8.
"""

from __future__ import annotations

import math

from numba import njit

from frontend.kernel_types import FAST, Bytes, Floats, Ints, Links


@njit(cache=True)
def estimate_normals(
    points: Floats,
    origin_x: float,
    origin_y: float,
    gap_m: float,
    gap_ratio: float,
    radius_m: float,
    most: int,
    normals: Floats,
) -> None:
    """Line fits through the neighbours of each beam. Cost: N (2 most + 1) at the most.

    points : (N, 2) end points in the order of the beams, seen from the origin.
    A neighbour counts while consecutive points are nearer than gap_m + gap_ratio * range; on each
    side two count at any distance, then those within radius_m, up to ``most``.
    normals : (N, 2) out, unit, towards the sensor; zero where no line fits (fewer than 3 points,
              or as thick as long).
    """
    n = points.shape[0]
    radius2 = radius_m * radius_m
    for i in range(n):
        normals[i, 0] = 0.0
        normals[i, 1] = 0.0
        vx = origin_x - points[i, 0]
        vy = origin_y - points[i, 1]
        r = math.sqrt(vx * vx + vy * vy)
        gap = gap_m + gap_ratio * r
        gap2 = gap * gap
        sx = 0.0
        sy = 0.0
        sxx = 0.0
        sxy = 0.0
        syy = 0.0
        count = 1
        for side in range(2):
            step = 1 if side == 0 else -1
            j = i
            for taken in range(most):
                k = j + step
                if k < 0 or k >= n:
                    break
                dx = points[k, 0] - points[j, 0]
                dy = points[k, 1] - points[j, 1]
                if dx * dx + dy * dy > gap2:
                    break
                ex = points[k, 0] - points[i, 0]
                ey = points[k, 1] - points[i, 1]
                if taken >= 2 and ex * ex + ey * ey > radius2:
                    break
                sx += ex
                sy += ey
                sxx += ex * ex
                sxy += ex * ey
                syy += ey * ey
                count += 1
                j = k
        if count < 3:
            continue
        mx = sx / count
        my = sy / count
        a = sxx / count - mx * mx
        b = sxy / count - mx * my
        c = syy / count - my * my
        half_trace = 0.5 * (a + c)
        root = math.sqrt(max(0.0, 0.25 * (a - c) * (a - c) + b * b))
        small = half_trace - root
        large = half_trace + root
        if large < 1e-8 or small > 0.09 * large:
            continue
        # eigenvector of the smaller eigenvalue
        angle = 0.5 * math.atan2(2.0 * b, a - c) + 0.5 * math.pi
        nx = math.cos(angle)
        ny = math.sin(angle)
        if nx * vx + ny * vy < 0.0:
            nx = -nx
            ny = -ny
        # a surface seen at less than 8 degrees is mostly mixed pixels
        if (nx * vx + ny * vy) < 0.14 * r:
            continue
        normals[i, 0] = nx
        normals[i, 1] = ny


@njit(cache=True)
def insert_points(
    points: Floats,
    normals: Floats,
    x: float,
    y: float,
    yaw: float,
    map_points: Floats,
    map_normals: Floats,
    map_weights: Floats,
    following: Links,
    count: int,
    head: Links,
    origin_x: float,
    origin_y: float,
    list_cell_m: float,
    merge_m: float,
) -> int:
    """Add a scan's points that have a normal to the linked lists. Returns the new count.

    A point nearer than merge_m to a map point of the same list cell and of nearly the same normal
    is averaged into it, so that the density of the map is bounded however often a wall is seen.
    map_weights counts what was averaged. The caller sees to room for all points.
    """
    c = math.cos(yaw)
    s = math.sin(yaw)
    rows, cols = head.shape
    merge2 = merge_m * merge_m
    for i in range(points.shape[0]):
        if normals[i, 0] == 0.0 and normals[i, 1] == 0.0:
            continue
        px = x + c * points[i, 0] - s * points[i, 1]
        py = y + s * points[i, 0] + c * points[i, 1]
        col = int(math.floor((px - origin_x) / list_cell_m))
        row = int(math.floor((py - origin_y) / list_cell_m))
        if row < 1 or col < 1 or row >= rows - 1 or col >= cols - 1:
            continue
        nx = c * normals[i, 0] - s * normals[i, 1]
        ny = s * normals[i, 0] + c * normals[i, 1]
        best = -1
        best2 = merge2
        j = head[row, col]
        while j >= 0:
            if nx * map_normals[j, 0] + ny * map_normals[j, 1] > 0.95:
                dx = px - map_points[j, 0]
                dy = py - map_points[j, 1]
                d2 = dx * dx + dy * dy
                if d2 < best2:
                    best2 = d2
                    best = j
            j = following[j]
        if best >= 0:
            w = map_weights[best]
            share = 1.0 / (w + 1.0)
            map_points[best, 0] += share * (px - map_points[best, 0])
            map_points[best, 1] += share * (py - map_points[best, 1])
            mx = map_normals[best, 0] + share * (nx - map_normals[best, 0])
            my = map_normals[best, 1] + share * (ny - map_normals[best, 1])
            length = math.sqrt(mx * mx + my * my)
            map_normals[best, 0] = mx / length
            map_normals[best, 1] = my / length
            if w < 20.0:
                map_weights[best] = w + 1.0
            continue
        map_points[count, 0] = px
        map_points[count, 1] = py
        map_normals[count, 0] = nx
        map_normals[count, 1] = ny
        map_weights[count] = 1.0
        following[count] = head[row, col]
        head[row, col] = count
        count += 1
    return count


@njit(cache=True)
def stamp_field(
    points: Floats,
    x: float,
    y: float,
    yaw: float,
    field: Bytes,
    level_starts: Ints,
    rows: int,
    cols: int,
    origin_x: float,
    origin_y: float,
    cell_m: float,
    blob: Bytes,
) -> None:
    """Raise the likelihood pyramid around a scan's points. Cost: N (blob + levels).

    field : flat uint8, all levels; level_starts : (levels + 1,) where each begins.
    rows, cols : of level 0, multiples of 2^(levels - 1). blob : (2 h + 1, 2 h + 1) uint8.
    """
    c = math.cos(yaw)
    s = math.sin(yaw)
    half = blob.shape[0] // 2
    levels = level_starts.shape[0] - 1
    margin = half + (1 << levels)
    for i in range(points.shape[0]):
        px = x + c * points[i, 0] - s * points[i, 1]
        py = y + s * points[i, 0] + c * points[i, 1]
        col = int(math.floor((px - origin_x) / cell_m))
        row = int(math.floor((py - origin_y) / cell_m))
        if row < margin or col < margin or row >= rows - margin or col >= cols - margin:
            continue
        if field[row * cols + col] == 255:
            continue
        for dr in range(-half, half + 1):
            at = (row + dr) * cols + col
            for dc in range(-half, half + 1):
                value = blob[dr + half, dc + half]
                if field[at + dc] < value:
                    field[at + dc] = value
        for level in range(1, levels):
            span = 1 << level
            level_cols = cols >> level
            # the cells whose window [k span, (k + 2) span) meets the blob
            row_first = (row - half) // span - 1
            row_last = (row + half) // span
            col_first = (col - half) // span - 1
            col_last = (col + half) // span
            for lr in range(row_first, row_last + 1):
                for lc in range(col_first, col_last + 1):
                    # nearest cell of that window to the point, for the tightest bound
                    dr = max(0, max(lr * span - row, row - ((lr + 2) * span - 1)))
                    dc = max(0, max(lc * span - col, col - ((lc + 2) * span - 1)))
                    value = blob[half + dr, half + dc]
                    at = level_starts[level] + lr * level_cols + lc
                    if field[at] < value:
                        field[at] = value


@njit(cache=True, fastmath=FAST)
def field_score(
    points: Floats,
    x: float,
    y: float,
    yaw: float,
    field: Bytes,
    rows: int,
    cols: int,
    origin_x: float,
    origin_y: float,
    cell_m: float,
) -> float:
    """Mean of level 0 under the points at a pose, in 0..1; points outside count as 0."""
    c = math.cos(yaw)
    s = math.sin(yaw)
    total = 0
    n = points.shape[0]
    for i in range(n):
        col = int(math.floor((x + c * points[i, 0] - s * points[i, 1] - origin_x) / cell_m))
        row = int(math.floor((y + s * points[i, 0] + c * points[i, 1] - origin_y) / cell_m))
        if 0 <= row < rows and 0 <= col < cols:
            total += field[row * cols + col]
    return total / (255.0 * max(n, 1))
